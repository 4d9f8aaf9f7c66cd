"""Draws a plan's timeline as an SVG picture: velocity, flow and bus load over print time."""

from collections.abc import Mapping, Sequence

from coordinator.planning.report import Timeline
from nodes.support.svg_chart import COLOURS, Panel, Series, draw_chart, staircase, ticks


def draw(title: str, timeline: Timeline) -> str:
    """Return the picture; TITLE may be any text."""
    load = {name: [100 * value for value in bins] for name, bins in timeline.bus_load.items()}
    end_s = timeline.bin_s * max(len(timeline.speed_mm_s), 1)
    panels = [
        _panel("velocity, mm/s", {"": timeline.speed_mm_s}, timeline.bin_s),
        _panel("flow, mm³/s", {"": timeline.flow_mm3_s}, timeline.bin_s),
        _panel("bus load, % of the bit rate", load, timeline.bin_s),
    ]
    return draw_chart(title, "print time, s", (0.0, end_s), ticks(0.0, end_s, 10), panels)


def _panel(heading: str, curves: Mapping[str, Sequence[float]], bin_s: float) -> Panel:
    highest = max((max(values, default=0.0) for values in curves.values()), default=0.0)
    series = [
        Series(staircase(values, bin_s), name, COLOURS[number % len(COLOURS)])
        for number, (name, values) in enumerate(curves.items())
    ]
    return Panel(heading, series, ticks(0.0, highest, 5))

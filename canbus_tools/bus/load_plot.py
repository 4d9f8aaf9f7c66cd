"""Draws how busy a bus was over time, by what the frames were for, as an SVG picture."""

from typing import Final

from canbus_tools.bus.bus_load import BusLoad, TrafficClass
from nodes.support.svg_chart import Panel, Series, draw_chart, ticks

COLOURS: Final = {
    TrafficClass.TO_NODES: "#1f6fb4",
    TrafficClass.FROM_NODES: "#2e8b57",
    TrafficClass.ADMIN: "#8e5bb5",
    TrafficClass.SIGNAL: "#c77d0a",
    TrafficClass.OTHER: "#8a8a8a",
    TrafficClass.ERROR: "#d1495b",
}
"""From the bottom to the top."""
_HEIGHT: Final = 256
_TIME_TICKS: Final = 12


def draw(title: str, load: BusLoad) -> str:
    """Return the picture; TITLE may be any text."""
    highest = 100 * max((window.load for window in load.windows), default=0.0)
    end_s = max(load.duration_s, 1e-3)
    window_s = load.windows[0].length_s if load.windows else 0.0
    figures = f"{load.mean:.1%} on average, {load.peak:.1%} in the busiest {load.window_s:g} s"
    panel = Panel("load, % of the bit rate", _areas(load), ticks(0.0, highest, 5), _HEIGHT)
    x_label = f"time, s (means of {window_s:g} s)"
    return draw_chart(f"{title}: {figures}", x_label, (0.0, end_s), ticks(0.0, end_s, _TIME_TICKS), [panel])


def _areas(load: BusLoad) -> list[Series]:
    """Return one area for each class, standing on those below."""
    floor = [0.0] * len(load.windows)
    found = []
    for kind, colour in COLOURS.items():
        if kind not in load.classes:
            continue
        roof = []
        for window, base in zip(load.windows, floor, strict=True):
            total = sum(window.bits.values())
            roof.append(base + (100 * window.load * window.bits.get(kind, 0) / total if total else 0.0))
        upper, lower = (
            [
                (x_s, level)
                for window, level in zip(load.windows, levels, strict=True)
                for x_s in (window.start_s, window.start_s + window.length_s)
            ]
            for levels in (roof, floor)
        )
        name = f"■ {kind.value} {load.classes[kind].share:.1%}"
        found.append(Series([*upper, *reversed(lower)], name, colour, filled=True))
        floor = roof
    return found

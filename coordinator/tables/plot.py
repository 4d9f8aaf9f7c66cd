"""Draws axis tables as an SVG picture: the corrections over the axis, for both directions of travel."""

from typing import Final

from coordinator.tables.axis_table import AxisTable, Unit
from nodes.support.svg_chart import COLOURS, Panel, Series, draw_chart, ticks

_FINE: Final = {Unit.MM: ("µm", 1e3), Unit.DEG: ("arcsec", 3600.0)}
"""What corrections are shown in, and how many of them are one unit."""
_HEIGHT: Final = 360


def draw(table: AxisTable) -> str:
    """Return the picture."""
    unit, scale = _FINE[table.unit]
    curves = {word: [scale * y for y in getattr(table, word)] for word in ("forward", "reverse")}
    every = [value for values in curves.values() for value in values]
    xs = ticks(table.positions[0], table.positions[-1])
    series = [
        Series(list(zip(table.positions, values, strict=True)), word, colour)
        for (word, values), colour in zip(curves.items(), COLOURS, strict=False)
    ]
    panel = Panel(f"correction, {unit}", series, ticks(min(every), max(every)), _HEIGHT)
    return draw_chart(f"axis {table.axis}", f"position, {table.unit}", (xs[0], xs[-1]), xs, [panel])

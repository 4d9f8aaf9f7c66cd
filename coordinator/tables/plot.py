"""Draws axis tables as an SVG picture: the corrections over the axis, for both directions of travel."""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Final

from coordinator.tables.axis_table import AxisTable, Unit

WIDTH, PANEL, LEFT, RIGHT, TOP, BOTTOM = 1000, 360, 80, 20, 52, 44
TICKS: Final = 6
COLOURS: Final = {"forward": "#1f6fb4", "reverse": "#d1495b"}
_FINE: Final = {Unit.MM: ("µm", 1e3), Unit.DEG: ("arcsec", 3600.0)}
"""What corrections are shown in, and how many of them are one unit."""
_STEPS: Final = (1, 2, 5, 10)


def draw(table: AxisTable) -> str:
    """Return the picture."""
    unit, scale = _FINE[table.unit]
    curves = {word: [scale * y for y in getattr(table, word)] for word in COLOURS}
    every = list(itertools.chain(*curves.values()))
    xs = _ticks(table.positions[0], table.positions[-1])
    ys = _ticks(min(every), max(every))
    height = TOP + PANEL + BOTTOM
    size = f'width="{WIDTH}" height="{height}"'
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" font-size="12">',
        f'<rect {size} fill="white"/>',
        f'<text x="{LEFT}" y="20" font-size="15">axis {_escape(table.axis)}</text>',
        f'<text x="{LEFT}" y="{TOP - 8}">correction, {unit}</text>',
        *_grid(xs, ys),
    ]
    names = []
    for word, values in curves.items():
        points = " ".join(
            f"{_x(position, xs):.1f},{_y(value, ys):.1f}"
            for position, value in zip(table.positions, values, strict=True)
        )
        lines.append(f'<polyline points="{points}" fill="none" stroke="{COLOURS[word]}" stroke-width="1.3"/>')
        names.append(f'<tspan dx="14" fill="{COLOURS[word]}">{word}</tspan>')
    middle = LEFT + (WIDTH - LEFT - RIGHT) // 2
    lines += [
        f'<text x="{WIDTH - RIGHT}" y="{TOP - 8}" text-anchor="end">{"".join(names)}</text>',
        f'<text x="{middle}" y="{height - 6}" text-anchor="middle">position, {table.unit}</text>',
        "</svg>\n",
    ]
    return "\n".join(lines)


def _grid(xs: Sequence[float], ys: Sequence[float]) -> Iterator[str]:
    for value in ys:
        y, strong = _y(value, ys), "#888" if value == 0 else "#ddd"
        yield f'<line x1="{LEFT}" y1="{y:.1f}" x2="{WIDTH - RIGHT}" y2="{y:.1f}" stroke="{strong}"/>'
        yield f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>'
    for value in xs:
        x = _x(value, xs)
        yield f'<line x1="{x:.1f}" y1="{TOP}" x2="{x:.1f}" y2="{TOP + PANEL}" stroke="#eee"/>'
        yield f'<text x="{x:.1f}" y="{TOP + PANEL + 16}" text-anchor="middle">{value:g}</text>'


def _x(value: float, ticks: Sequence[float]) -> float:
    return LEFT + (WIDTH - LEFT - RIGHT) * (value - ticks[0]) / (ticks[-1] - ticks[0])


def _y(value: float, ticks: Sequence[float]) -> float:
    return TOP + PANEL * (ticks[-1] - value) / (ticks[-1] - ticks[0])


def _ticks(low: float, high: float) -> list[float]:
    """Return round numbers, equally far apart, from LOW or below to HIGH or above."""
    room = high - low or abs(high) or 1.0
    power = 10.0 ** math.floor(math.log10(room / TICKS))
    step = next(factor * power for factor in _STEPS if factor * power * TICKS >= room * 0.999)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [float(f"{number * step:.12g}") for number in range(first, max(last, first + 1) + 1)]


def _escape(text: str) -> str:
    shown = "".join(c if c.isprintable() else "?" for c in text)
    return shown.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")

"""Line charts as SVG text: stacked panels with a common x axis, grid, ticks and legend."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from nodes.support.terminal import printable

COLOURS: Final = ("#1f6fb4", "#d1495b", "#2e8b57", "#8e5bb5", "#c77d0a", "#4a4a4a")
WIDTH, LEFT, RIGHT, TOP, GAP, BOTTOM = 1000, 80, 20, 52, 50, 44
COLUMNS_MAX: Final = 1000
"""Most points of a curve: the picture has no more pixels."""
_TICK_STEPS: Final = (1, 2, 5, 10)

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Series:
    """One curve."""

    points: Sequence[Point]
    name: str = ""
    """Text of the legend; empty: none."""
    colour: str = COLOURS[0]
    filled: bool = False
    """Whether POINTS are the outline of an area."""


@dataclass(frozen=True, slots=True)
class Panel:
    """One drawing area."""

    heading: str
    series: Sequence[Series]
    y_ticks: Sequence[float]
    """Rising; the first and the last are the limits of the panel."""
    height: int = 170


def draw_chart(
    title: str, x_label: str, x_range: Point, x_ticks: Sequence[float], panels: list[Panel]
) -> str:
    """Return the picture; texts are escaped. X_RANGE: values at the left and the right border."""
    height = TOP + sum(panel.height + GAP for panel in panels) - GAP + BOTTOM
    size = f'width="{WIDTH}" height="{height}"'
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" font-size="12">',
        f'<rect {size} fill="white"/>',
        f'<text x="{LEFT}" y="20" font-size="15">{escape(title)}</text>',
    ]
    top = TOP
    for panel in panels:
        lines += _panel(panel, top, x_range, x_ticks)
        top += panel.height + GAP
    middle = (LEFT + WIDTH - RIGHT) // 2
    lines += [
        f'<text x="{middle}" y="{height - 6}" text-anchor="middle">{escape(x_label)}</text>',
        "</svg>\n",
    ]
    return "\n".join(lines)


def ticks(low: float, high: float, count: int = 6) -> list[float]:
    """Return about COUNT equidistant round numbers, from LOW or below to HIGH or above."""
    span = high - low or abs(high) or 1.0
    power = 10.0 ** math.floor(math.log10(span / count))
    step = next(factor * power for factor in _TICK_STEPS if factor * power * count >= span * 0.999)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [float(f"{number * step:.12g}") for number in range(first, max(last, first + 1) + 1)]


def staircase(values: Sequence[float], bin_width: float) -> list[Point]:
    """Return a step curve of VALUES, each BIN_WIDTH wide; of too many values, the maximum of each group."""
    group = -(-len(values) // COLUMNS_MAX) or 1
    points = []
    for first in range(0, len(values), group):
        members = values[first : first + group]
        points += [(edge * bin_width, max(members)) for edge in (first, first + len(members))]
    return points


def escape(text: str) -> str:
    """Return TEXT escaped for SVG, without control characters."""
    return printable(text).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def _panel(panel: Panel, top: int, x_range: Point, x_ticks: Sequence[float]) -> Iterator[str]:
    right, bottom = WIDTH - RIGHT, top + panel.height
    low, high = panel.y_ticks[0], panel.y_ticks[-1]

    def x_of(value: float) -> float:
        return LEFT + (right - LEFT) * (value - x_range[0]) / (x_range[1] - x_range[0])

    def y_of(value: float) -> float:
        return bottom - panel.height * (value - low) / (high - low)

    for series in (one for one in panel.series if one.filled):
        yield f'<polygon points="{_points(series, x_of, y_of)}" fill="{series.colour}"/>'
    yield f'<text x="{LEFT}" y="{top - 8}">{escape(panel.heading)}</text>'
    for value in panel.y_ticks:
        y = y_of(value)
        opacity = 0.5 if value == 0 else 0.15
        yield f'<line x1="{LEFT}" y1="{y:.1f}" x2="{right}" y2="{y:.1f}" stroke="#000" opacity="{opacity}"/>'
        yield f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>'
    for value in (tick for tick in x_ticks if x_range[0] <= tick <= x_range[1]):
        x = x_of(value)
        yield f'<line x1="{x:.1f}" y1="{top}" x2="{x:.1f}" y2="{bottom}" stroke="#000" opacity="0.1"/>'
        yield f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{value:g}</text>'
    for series in (one for one in panel.series if not one.filled):
        line = f'fill="none" stroke="{series.colour}" stroke-width="1.3"'
        yield f'<polyline points="{_points(series, x_of, y_of)}" {line}/>'
    names = "".join(
        f'<tspan dx="14" fill="{series.colour}">{escape(series.name)}</tspan>'
        for series in panel.series
        if series.name
    )
    yield f'<text x="{right}" y="{top - 8}" text-anchor="end">{names}</text>'


def _points(series: Series, x_of: Callable[[float], float], y_of: Callable[[float], float]) -> str:
    return " ".join(f"{x_of(x):.1f},{y_of(y):.1f}" for x, y in series.points)

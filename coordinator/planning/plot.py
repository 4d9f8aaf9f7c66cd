"""Draws a plan's timeline as an SVG picture: velocity, flow and bus load over print time."""

from collections.abc import Iterator, Sequence

from coordinator.planning.report import Timeline

WIDTH, PANEL, LEFT, RIGHT, TOP, GAP, BOTTOM = 1000, 170, 70, 20, 52, 50, 40
COLOURS = ("#1f6fb4", "#d1495b", "#2e8b57", "#8e5bb5", "#c77d0a", "#4a4a4a")
TICKS = 5
COLUMNS_MAX = 1000
"""More bins than that are drawn as the highest of several: the picture has no more pixels."""

Curve = tuple[str, Sequence[float]]


def draw(title: str, timeline: Timeline) -> str:
    """Return the picture; TITLE may be any text."""
    load = [(name, [100 * value for value in bins]) for name, bins in timeline.bus_load.items()]
    panels: list[tuple[str, list[Curve]]] = [
        ("velocity, mm/s", [("", timeline.speed_mm_s)]),
        ("flow, mm³/s", [("", timeline.flow_mm3_s)]),
        ("bus load, % of the bit rate", [*load]),
    ]
    end_s = timeline.bin_s * max(len(timeline.speed_mm_s), 1)
    height = TOP + len(panels) * (PANEL + GAP) - GAP + BOTTOM
    size = f'width="{WIDTH}" height="{height}"'
    middle = LEFT + (WIDTH - LEFT - RIGHT) // 2
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" font-size="12">',
        f'<rect {size} fill="white"/>',
        f'<text x="{LEFT}" y="20" font-size="15">{_escape(title)}</text>',
    ]
    for number, (heading, curves) in enumerate(panels):
        lines += _panel(TOP + number * (PANEL + GAP), heading, curves, timeline.bin_s, end_s)
    lines += [
        f'<text x="{middle}" y="{height - 6}" text-anchor="middle">print time, s</text>',
        "</svg>\n",
    ]
    return "\n".join(lines)


def _panel(top: int, heading: str, curves: list[Curve], bin_s: float, end_s: float) -> Iterator[str]:
    width = WIDTH - LEFT - RIGHT
    high = _round_up(max((max(values, default=0.0) for _, values in curves), default=0.0))
    yield f'<text x="{LEFT}" y="{top - 6}">{heading}</text>'
    for i in range(TICKS + 1):
        y = top + PANEL - PANEL * i / TICKS
        yield f'<line x1="{LEFT}" y1="{y:.1f}" x2="{LEFT + width}" y2="{y:.1f}" stroke="#ddd"/>'
        yield f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{high * i / TICKS:g}</text>'
    step = _round_up(end_s / 10)
    for i in range(int(end_s / step) + 1):
        x = LEFT + width * i * step / end_s
        yield f'<line x1="{x:.1f}" y1="{top}" x2="{x:.1f}" y2="{top + PANEL}" stroke="#eee"/>'
        yield f'<text x="{x:.1f}" y="{top + PANEL + 15}" text-anchor="middle">{i * step:g}</text>'
    for number, (_, values) in enumerate(curves):
        colour = COLOURS[number % len(COLOURS)]
        yield _curve(values, colour, (LEFT, top + PANEL), (width * bin_s / end_s, PANEL / high))
    names = "".join(
        f'<tspan dx="14" fill="{COLOURS[number % len(COLOURS)]}">{_escape(name)}</tspan>'
        for number, (name, _) in enumerate(curves)
    )
    yield f'<text x="{LEFT + width}" y="{top - 6}" text-anchor="end">{names}</text>'


def _curve(values: Sequence[float], colour: str, origin: tuple[int, int], scale: tuple[float, float]) -> str:
    """Return a staircase: a bin's figure holds for its whole length."""
    group = -(-len(values) // COLUMNS_MAX) or 1
    points = []
    for first in range(0, len(values), group):
        members = values[first : first + group]
        y = origin[1] - max(members) * scale[1]
        points += [f"{origin[0] + edge * scale[0]:.1f},{y:.1f}" for edge in (first, first + len(members))]
    return f'<polyline points="{" ".join(points)}" fill="none" stroke="{colour}" stroke-width="1.3"/>'


def _round_up(value: float) -> float:
    """Return the next short number from VALUE on; 1 for nothing."""
    if value <= 0:
        return 1.0
    short = (1, 1.5, 2, 3, 4, 5, 6, 8)
    candidates = (factor * 10.0**exponent for exponent in range(-6, 13) for factor in short)
    return next((candidate for candidate in candidates if value <= candidate), value)


def _escape(text: str) -> str:
    shown = "".join(c if c.isprintable() else "?" for c in text)
    return shown.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")

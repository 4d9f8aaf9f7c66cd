"""Draws how busy a bus was over time, by what the frames were for, as an SVG picture."""

from typing import Final

from canbus_tools.bus.bus_load import BusLoad, TrafficClass

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 1000, 360, 60, 20, 60, 44
COLOURS: Final = {
    TrafficClass.TO_NODES: "#1f6fb4",
    TrafficClass.FROM_NODES: "#2e8b57",
    TrafficClass.ADMIN: "#8e5bb5",
    TrafficClass.SIGNAL: "#c77d0a",
    TrafficClass.OTHER: "#8a8a8a",
    TrafficClass.ERROR: "#d1495b",
}
"""From the bottom to the top."""
_HEIGHTS: Final = (1, 2, 5, 10, 20, 40, 60, 80, 100)
_STEPS: Final = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1800, 3600, 7200)


def draw(title: str, load: BusLoad) -> str:
    """Return the picture; TITLE may be any text."""
    highest = 100 * max((window.load for window in load.windows), default=0.0)
    top = next((percent for percent in _HEIGHTS if highest <= percent), highest)
    end_s = max(load.duration_s, 1e-3)
    scale = ((WIDTH - LEFT - RIGHT) / end_s, (HEIGHT - TOP - BOTTOM) / top)
    figures = f"{load.mean:.1%} on average, {load.peak:.1%} in the busiest {load.window_s:g} s"
    size = f'width="{WIDTH}" height="{HEIGHT}"'
    window_s = load.windows[0].length_s if load.windows else 0.0
    means = f"means of {window_s:g} s"
    middle = (LEFT + WIDTH - RIGHT) // 2
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" font-size="12">',
        f'<rect {size} fill="white"/>',
        f'<text x="{LEFT}" y="20" font-size="15">{_escape(title)}: {figures}</text>',
        *_areas(load, scale),
        *_grid(top, end_s, scale),
        _legend(load),
        f'<text x="{middle}" y="{HEIGHT - 8}" text-anchor="middle">time, s ({means})</text>',
        "</svg>\n",
    ]
    return "\n".join(lines)


def _areas(load: BusLoad, scale: tuple[float, float]) -> list[str]:
    """Return one staircase for each class, standing on those below."""
    floor = [0.0] * len(load.windows)
    found = []
    for kind, colour in COLOURS.items():
        if kind not in load.classes:
            continue
        roof = []
        for window, base in zip(load.windows, floor, strict=True):
            total = sum(window.bits.values())
            roof.append(base + (100 * window.load * window.bits.get(kind, 0) / total if total else 0.0))
        points: list[str] = []
        for levels, backward in ((roof, False), (floor, True)):
            edge = [
                f"{LEFT + x_s * scale[0]:.1f},{HEIGHT - BOTTOM - level * scale[1]:.1f}"
                for window, level in zip(load.windows, levels, strict=True)
                for x_s in (window.start_s, window.start_s + window.length_s)
            ]
            points += reversed(edge) if backward else edge
        found.append(f'<polygon points="{" ".join(points)}" fill="{colour}"/>')
        floor = roof
    return found


def _grid(top: float, end_s: float, scale: tuple[float, float]) -> list[str]:
    bottom = HEIGHT - BOTTOM
    found = []
    for i in range(6):
        percent = top * i / 5
        y = bottom - percent * scale[1]
        found.append(
            f'<line x1="{LEFT}" y1="{y:.1f}" x2="{WIDTH - RIGHT}" y2="{y:.1f}" stroke="#000" opacity="0.15"/>'
        )
        found.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{percent:g} %</text>')
    step = next((step for step in _STEPS if end_s / step <= 12), end_s / 12)
    for i in range(int(end_s / step + 1e-9) + 1):
        x = LEFT + i * step * scale[0]
        found.append(f'<line x1="{x:.1f}" y1="{bottom}" x2="{x:.1f}" y2="{bottom + 4}" stroke="#000"/>')
        found.append(f'<text x="{x:.1f}" y="{bottom + 17}" text-anchor="middle">{i * step:g}</text>')
    return found


def _legend(load: BusLoad) -> str:
    names = "".join(
        f'<tspan dx="14" fill="{colour}">■ {kind.value} {load.classes[kind].share:.1%}</tspan>'
        for kind, colour in COLOURS.items()
        if kind in load.classes
    )
    return f'<text x="{LEFT - 14}" y="44">{names}</text>'


def _escape(text: str) -> str:
    shown = "".join(c if c.isprintable() else "?" for c in text)
    return shown.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")

"""G-code for simulations, made from a seed: short moves with many changes.

It consists of strokes like those of a slicer, each at its own speed: lines, curves of short segments, zigzags
with sharp turns, dashes at full speed, hops with retraction, pauses.
"""

import math
import random
from collections.abc import Callable, Iterable, Iterator
from typing import Final

from coordinator.simulate.scenario import Program
from coordinator.support.toml_values import Dice

ORIGIN_MM: Final = 10.0
EXTRUSION: Final = 0.04
"""mm of filament per mm of travel."""
DASH_MM: Final = 14.0
RETRACT_MM: Final = 0.6
HOP_MM: Final = 0.3


def make_program(program: Program, dice: Dice) -> str:
    """Return the g-code of PROGRAM, drawn with DICE."""
    if program.lines:
        return program.lines
    pen = _Pen(dice.stream("program"), program.size_mm, dice.draw(program.speed_mm_s, "speed"))
    lines = ["G28", "G90", "M83", "G92 E0", *pen.to_begin()]
    for _ in range(round(dice.draw(program.strokes, "strokes"))):
        lines += pen.stroke()
    lines += pen.to_and_fro(dice.draw(program.long_s, "long"))
    if program.fan:
        lines = list(_with_fan(lines, program.fan, dice.stream("fan")))
    return "\n".join([program.begin, *lines, program.end, ""])


def _with_fan(lines: Iterable[str], share: float, rng: random.Random) -> Iterator[str]:
    """Yield LINES; after a ratio SHARE of them the fan speed changes."""
    for line in lines:
        yield line
        if rng.random() < share:
            yield f"M106 S{rng.randrange(256)}"


class _Pen:
    """The position of the tool, and the strokes it can make."""

    def __init__(self, rng: random.Random, size_mm: float, speed_mm_s: float) -> None:
        self._rng = rng
        self._size = size_mm
        self._speed = speed_mm_s
        self._x = self._y = ORIGIN_MM + size_mm / 2
        self._z = 0.2

    def to_begin(self) -> Iterator[str]:
        yield f"G1 Z{self._z:.3f} F600"
        yield f"G1 X{self._x:.3f} Y{self._y:.3f} F6000"

    def stroke(self) -> list[str]:
        """Return the lines of one stroke."""
        strokes: tuple[Callable[[], Iterator[str]], ...] = (
            *(self._line, self._curve, self._zigzag, self._dash, self._hop, self._pause),
        )
        chosen = self._rng.choices(strokes, weights=(8, 4, 3, 2, 2, 1))[0]
        return list(chosen())

    def to_and_fro(self, time_s: float) -> list[str]:
        """Return slow moves that take about TIME_S."""
        lines = []
        for n in range(math.ceil(time_s / 0.5)):
            self._x = ORIGIN_MM + (2.0 if n % 2 else 0.0)
            self._y = ORIGIN_MM + n % 3
            lines.append(f"G1 X{self._x:.3f} Y{self._y:.3f} Z{self._z + 0.1 * (n % 2):.3f} E0.05 F240")
        return lines

    def _feed(self) -> int:
        """Return a speed in mm/min."""
        return round(60 * self._speed * 10 ** self._rng.uniform(-1, 0))

    def _to(self, x: float, y: float, feed: int, *, extrude: bool = True) -> str:
        x = min(max(x, ORIGIN_MM), ORIGIN_MM + self._size)
        y = min(max(y, ORIGIN_MM), ORIGIN_MM + self._size)
        way = math.hypot(x - self._x, y - self._y)
        self._x, self._y = x, y
        words = f" E{way * EXTRUSION:.5f}" if extrude else ""
        return f"G1 X{x:.4f} Y{y:.4f}{words} F{feed}"

    def _anywhere(self) -> tuple[float, float]:
        return (
            ORIGIN_MM + self._rng.uniform(0, self._size),
            ORIGIN_MM + self._rng.uniform(0, self._size),
        )

    def _line(self) -> Iterator[str]:
        yield self._to(*self._anywhere(), self._feed(), extrude=self._rng.random() < 0.8)

    def _curve(self) -> Iterator[str]:
        feed, angle = self._feed(), self._rng.uniform(0, math.tau)
        length, turn = self._rng.uniform(0.05, 0.4), self._rng.uniform(-0.5, 0.5)
        for _ in range(self._rng.randrange(8, 24)):
            angle += turn
            yield self._to(self._x + length * math.cos(angle), self._y + length * math.sin(angle), feed)

    def _zigzag(self) -> Iterator[str]:
        feed, length = self._feed(), self._rng.uniform(0.1, 1.5)
        along_x = self._rng.random() < 0.5
        for n in range(self._rng.randrange(4, 12)):
            way = length if n % 2 else -length
            yield self._to(self._x + way * along_x, self._y + way * (not along_x), feed)

    def _dash(self) -> Iterator[str]:
        x = ORIGIN_MM if self._x > ORIGIN_MM + self._size / 2 else ORIGIN_MM + DASH_MM
        self._x = min(x, ORIGIN_MM + self._size)
        yield f"G1 X{x:.3f} F{round(60 * self._speed)}"
        yield f"G1 X{self._x:.3f} F{round(60 * self._speed)}"

    def _hop(self) -> Iterator[str]:
        yield f"G1 E-{RETRACT_MM} F1500"
        yield f"G1 Z{self._z + HOP_MM:.3f} F900"
        yield self._to(*self._anywhere(), self._feed(), extrude=False)
        yield f"G1 Z{self._z:.3f} F900"
        yield f"G1 E{RETRACT_MM} F1500"

    def _pause(self) -> Iterator[str]:
        yield f"G4 P{self._rng.randrange(5, 300)}"

"""A slow, obvious twin of the G-code hot path and the look-ahead.

It sees the whole program at once and relaxes every bound until nothing changes: no lazy flush, no passes in a
clever order, angles by arc functions, numbers by float().
"""

import math
import re
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from coordinator.motion.planner.planner import Position
from coordinator.motion.specs import MotionLimits

WORD = re.compile(r"([XYZEF])([+-]?\d*\.?\d*)")


@dataclass
class Move:
    start: Position
    ratio: tuple[float, ...]
    length: float
    accel: float
    asked_accel: float
    speed: float
    scv: float
    cruise_ratio: float
    icv: float

    @property
    def extrudes_only(self) -> bool:
        return self.ratio[:3] == (0, 0, 0)


class Profile(NamedTuple):
    """Speeds of one planned move, mm/s, and its duration."""

    start_v: float
    cruise_v: float
    end_v: float
    duration_s: float


class Language:
    """G-code text to moves; knows only what the compared programs contain."""

    def __init__(self, limits: MotionLimits, position: Position) -> None:
        self.limits = limits
        self.at = list(position)
        self.base = [0.0] * 4
        self.relative_e = False
        self.speed = 25.0
        self.accel = {"P": limits.max_accel, "T": limits.max_accel}
        """Of moves with filament (P) and without (T)."""
        self.moves: list[Move] = []

    def line(self, line: str) -> None:
        code, _, rest = line.split(";", maxsplit=1)[0].strip().partition(" ")
        words = {letter: float(value) for letter, value in WORD.findall(rest)}
        if code in {"G0", "G1"}:
            self.speed = words.pop("F", self.speed * 60) / 60
            self.move(words)
        elif code == "G92":
            for letter, value in words.items():
                self.base["XYZE".index(letter)] = self.at["XYZE".index(letter)] - value
        elif code in {"M82", "M83"}:
            self.relative_e = code == "M83"
        elif code == "M204":
            accel = min(float(rest[1:]), self.limits.max_accel)
            self.accel |= dict.fromkeys("PT" if rest[0] == "S" else rest[0], accel)

    def move(self, words: dict[str, float]) -> None:
        target = list(self.at)
        for letter, value in words.items():
            axis = "XYZE".index(letter)
            target[axis] = value + (self.at if axis == 3 and self.relative_e else self.base)[axis]
        delta = [b - a for a, b in zip(self.at, target, strict=True)]
        length = math.dist(self.at[:3], target[:3]) or abs(delta[3])
        if length:
            self.moves.append(self.limited(tuple(d / length for d in delta), length))
        self.at = target

    def limited(self, ratio: tuple[float, ...], length: float) -> Move:
        limits = self.limits
        asked = self.accel["P" if ratio[3] else "T"]
        speed, accel = min(self.speed, limits.max_velocity), asked
        z, e = abs(ratio[2]), abs(ratio[3])
        if z:
            speed, accel = min(speed, limits.max_z_velocity / z), min(accel, limits.max_z_accel / z)
        if ratio[:3] == (0, 0, 0) or ratio[3] < 0 or e > limits.max_extrude_ratio:
            speed = min(speed, limits.max_extrude_only_velocity / e)
            accel = min(accel, limits.max_extrude_only_accel / e)
        x0, y0, z0, e0 = self.at
        return Move(
            (x0, y0, z0, e0),
            ratio,
            length,
            accel,
            asked,
            speed,
            limits.square_corner_velocity,
            limits.minimum_cruise_ratio,
            limits.instantaneous_corner_velocity,
        )


def corner_speed(a: Move, b: Move) -> float:
    """Highest speed at which A may go over into B, mm/s."""
    if a.extrudes_only or b.extrudes_only:
        return 0.0
    bounds = [a.speed, b.speed]
    jump = abs(a.ratio[3] - b.ratio[3])
    if jump > 1e-9:
        bounds.append(b.icv / jump)
    # The inner angle, by Kahan's formula: precise at both ends.
    u, v = a.ratio[:3], b.ratio[:3]
    turn = 2 * math.atan2(math.dist(u, v), math.hypot(*(p + q for p, q in zip(u, v, strict=True))))
    inner = math.pi - turn
    if turn > 2e-8:
        for move in (a, b):
            deviation = move.scv**2 * (math.sqrt(2) - 1) / move.asked_accel
            # 1 - sin(inner/2) = 1 - cos(turn/2) = 2·sin²(turn/4)
            radius = deviation * math.sin(inner / 2) / (2 * math.sin(turn / 4) ** 2)
            bounds.append(math.sqrt(max(0.0, radius * move.accel)))
            bounds.append(math.sqrt(max(0.0, move.length / 2 * math.tan(inner / 2) * move.accel)))
    return min(bounds)


def relax(bounds: list[float], reach: list[float]) -> list[float]:
    """Lower BOUNDS (v² at junctions) until no neighbours differ by more than REACH; to the fixed point."""
    v2 = list(bounds)
    changed = True
    while changed:
        changed = False
        for i, allowed in enumerate(reach):
            for a, b in ((i, i + 1), (i + 1, i)):
                if v2[a] > v2[b] + allowed:
                    v2[a] = v2[b] + allowed
                    changed = True
    return v2


def hill_tops(moves: list[Move], smooth: list[float], reach: list[float]) -> list[float]:
    """For each move, the top (v²) of the hill of the SMOOTH profile in which it lies."""
    peaks = [
        max(min(m.speed**2, (smooth[i] + smooth[i + 1] + reach[i]) / 2), smooth[i], smooth[i + 1])
        for i, m in enumerate(moves)
    ]
    tops: list[float] = []
    first, falls = 0, False
    for i, peak in enumerate(peaks):
        if falls and peak > smooth[i] * (1 + 1e-9):
            tops += [max(peaks[first:i])] * (i - first)
            first, falls = i, False
        falls = falls or peak > smooth[i + 1] * (1 + 1e-9)
    return tops + [max(peaks[first:], default=0.0)] * (len(peaks) - first)


def plan(moves: list[Move]) -> list[Profile]:
    """Plan MOVES from standstill to standstill."""
    if not moves:
        return []
    corners = [0.0, *(corner_speed(a, b) ** 2 for a, b in pairwise(moves)), 0.0]
    reach = [2 * m.accel * m.length for m in moves]
    smooth_reach = [
        r * (1 if m.extrudes_only else 1 - m.cruise_ratio) for m, r in zip(moves, reach, strict=True)
    ]
    v2 = relax(corners, reach)
    tops = hill_tops(moves, relax(corners, smooth_reach), smooth_reach)
    profiles = []
    for i, move in enumerate(moves):
        start = min(v2[i], tops[i], tops[max(i - 1, 0)])
        end = min(v2[i + 1], tops[i], tops[min(i + 1, len(moves) - 1)])
        cruise = max(min(move.speed**2, tops[i], (start + end + reach[i]) / 2), start, end)
        v0, v1, v = math.sqrt(start), math.sqrt(end), math.sqrt(cruise)
        way = move.length - ((cruise - start) + (cruise - end)) / (2 * move.accel)
        profiles.append(Profile(v0, v, v1, (2 * v - v0 - v1) / move.accel + max(0.0, way) / v))
    return profiles

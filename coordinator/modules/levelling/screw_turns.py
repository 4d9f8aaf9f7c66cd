"""By how much screws have to be turned: pure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

PITCH_MM: Final[Mapping[str, float]] = {"M3": 0.5, "M4": 0.7, "M5": 0.8, "M6": 1.0, "M8": 1.25}
"""Of a turn of metric screws with coarse thread."""
THREADS: Final = tuple(f"{way}-{size}" for size in PITCH_MM for way in ("CW", "CCW"))
MINUTES: Final = 60


@dataclass(frozen=True, slots=True)
class Turn:
    """What has to be done to one screw."""

    height: float
    """Of the bed above it, as it was measured, mm."""
    rise_mm: float
    """By how much it has to be raised."""
    direction: str
    """CW or CCW, seen by who turns the knob."""
    adjust: str
    """Full turns, and minutes of a clock's face: ``01:15`` are one and a quarter."""
    is_base: bool
    """Whether it stays as it is."""


def screw_turns(heights: Sequence[float], thread: str, direction: str = "") -> tuple[Turn, ...]:
    """Return the turns that bring HEIGHTS (mm) of screws with THREAD (``CW-M3``) to one level.

    The first screw stays; with DIRECTION (CW, CCW) the one stays for which all others turn that way. A knob
    of a CW thread raises the bed when it is turned clockwise.
    """
    way, _, size = thread.partition("-")
    base_number = 0
    if direction:
        highest_or_lowest = max if direction == way else min
        base_number = highest_or_lowest(range(len(heights)), key=heights.__getitem__)
    base = heights[base_number]
    return tuple(
        _turn(height, base - height, way, PITCH_MM[size], is_base=number == base_number)
        for number, height in enumerate(heights)
    )


def _turn(height: float, rise_mm: float, way: str, pitch_mm: float, *, is_base: bool) -> Turn:
    other = "CCW" if way == "CW" else "CW"
    minutes = round(abs(rise_mm) / pitch_mm * MINUTES)
    adjust = f"{minutes // MINUTES:02d}:{minutes % MINUTES:02d}"
    return Turn(height, rise_mm, way if rise_mm >= 0 else other, adjust, is_base)

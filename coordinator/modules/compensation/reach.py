"""How far a correction drives motors beyond the range that moves of programs are held to."""

from collections.abc import Callable
from itertools import product
from typing import Final

from coordinator.kinematics.base import Point
from coordinator.motion.specs import MotionLimits

BEYOND_MM: Final = 5.0
"""As much as two planes that lean by 0.5 % each need on a machine of 500 mm."""


def beyond_range(limits: MotionLimits, driven: Callable[[Point], Point]) -> str:
    """Return what is wrong where motors DRIVEN to the corners of LIMITS go too far; empty: nothing is."""
    by_mm = dict.fromkeys("XYZ", 0.0)
    for ends in product((0, 1), repeat=3):
        x, y, z = ((limits.position_min, limits.position_max)[end][axis] for axis, end in enumerate(ends))
        for letter, end, at, to in zip("XYZ", ends, (x, y, z), driven((x, y, z)), strict=True):
            by_mm[letter] = max(by_mm[letter], to - at if end else at - to)
    letter = max(by_mm, key=lambda letter: by_mm[letter])
    if by_mm[letter] <= BEYOND_MM:
        return ""
    return (
        f"at a corner it would drive {letter} {by_mm[letter]:.1f} mm beyond position_min or position_max,"
        f" and {BEYOND_MM:g} mm are allowed"
    )

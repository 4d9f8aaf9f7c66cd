"""Impulses of the input shapers, from the literature; nothing of the engine.

N. Singer, W. Seering (1990): zv, zvd. W. Singhose (1994, 1997): ei and its forms of two and three humps, here
for a residual vibration of 5 %, or what ``ei(v_tol=0.03)`` says. mzv: as zv, with three impulses over three
quarters of a period.
"""

import math

from coordinator.verification.exact_path import Impulses

TOLERANCE = 0.05
KINDS = ("zv", "mzv", "zvd", "ei", "2hump_ei", "3hump_ei")


def impulses(kind: str, frequency_hz: float, damping_ratio: float) -> Impulses:
    """Return (amplitude, delay in s) of each impulse, with sum 1 and mean delay 0."""
    root = math.sqrt(1 - damping_ratio**2)
    name, _, tolerance = kind.rstrip(" )").partition("(")
    amplitudes, spacing = _undamped(name, float(tolerance.partition("=")[2] or TOLERANCE))
    # A vibration decays by this factor from one impulse to the next, so the next has to be as much smaller.
    decay = math.exp(-2 * math.pi * spacing * damping_ratio / root)
    damped = [a * decay**i for i, a in enumerate(amplitudes)]
    total = sum(damped)
    times = [i * spacing / (frequency_hz * root) for i in range(len(damped))]
    mean = sum(a * t for a, t in zip(damped, times, strict=True)) / total
    return tuple((a / total, t - mean) for a, t in zip(damped, times, strict=True))


def _undamped(kind: str, v: float) -> tuple[list[float], float]:
    """Return the amplitudes without damping, and their distance in periods. V: the residual vibration."""
    outer = 1 - math.sqrt(0.5)
    x = (v * v * (math.sqrt(1 - v * v) + 1)) ** (1 / 3)
    two = (3 * x * x + 2 * x + 3 * v * v) / (16 * x)
    three = (1 + 3 * v + 2 * math.sqrt(2 * (v + 1) * v)) / 16
    found: dict[str, tuple[list[float], float]] = {
        "zv": ([0.5, 0.5], 0.5),
        "mzv": ([outer, math.sqrt(2) - 1, outer], 0.375),
        "zvd": ([0.25, 0.5, 0.25], 0.5),
        "ei": ([(1 + v) / 4, (1 - v) / 2, (1 + v) / 4], 0.5),
        "2hump_ei": ([two, 0.5 - two, 0.5 - two, two], 0.5),
        "3hump_ei": ([three, (1 - v) / 4, (1 + v) / 2 - 2 * three, (1 - v) / 4, three], 0.5),
    }
    return found[kind]

"""Impulses of the input shapers, from the frequency and the damping of the resonance they cancel.

Sources: Singer and Seering 1990 (zv, zvd), Singhose, Seering and Singer 1996 (ei and its humped relatives).
"""

import math
import re

from nodes.support.errors import CanductorError

Impulses = tuple[tuple[float, float], ...]
"""(amplitude, time in s) each: amplitudes sum to 1, and the sum of amplitude times time is 0."""

SHAPER_KINDS = ("zv", "mzv", "zvd", "ei", "2hump_ei", "3hump_ei")
VIBRATION = 0.05
"""Share of the vibration that the ei shapers let through at their own frequency, unless their v_tol says."""
TOLERANT_KINDS = ("ei", "2hump_ei", "3hump_ei")
MAX_TOLERANCE = 0.5
REACH_MAX_S = 1.0
"""How far from a moment the impulses of a shaper may be; step_change.c refuses more."""
_WRITTEN = re.compile(r"([a-z0-9_]+)(?:\( *v_tol *= *(\d+(?:\.\d*)?|\.\d+) *\))?", re.ASCII)


def split_kind(written: str) -> tuple[str, float]:
    """Return the kind of shaper and its tolerance, of ``mzv`` or ``ei(v_tol=0.03)``.

    Raises ValueError, the end of a sentence.
    """
    match = _WRITTEN.fullmatch(written)
    kind = match[1] if match else ""
    if match is None or kind not in SHAPER_KINDS:
        raise ValueError(f"there are {', '.join(SHAPER_KINDS)}; those with ei also as ei(v_tol=0.05)")
    if match[2] is None:
        return kind, VIBRATION
    if kind not in TOLERANT_KINDS:
        raise ValueError(f"only {', '.join(TOLERANT_KINDS)} have a v_tol; remove it")
    tolerance = float(match[2])
    if not 0 < tolerance <= MAX_TOLERANCE:
        raise ValueError(f"v_tol must be above 0 and at most {MAX_TOLERANCE:g}")
    return kind, tolerance


def shaper_impulses(written: str, frequency_hz: float, damping_ratio: float) -> Impulses:
    """Return the centred impulses of a shaper, WRITTEN as its kind, perhaps with its tolerance.

    FREQUENCY_HZ > 0, 0 <= DAMPING_RATIO < 1. Raises CanductorError on other values.

    >>> shaper_impulses("zv", 50.0, 0.0)
    ((0.5, -0.005), (0.5, 0.005))
    """
    try:
        kind, tolerance = split_kind(written)
    except ValueError as problem:
        raise CanductorError(f"there is no input shaper {written!r}: {problem}") from None
    if not (0 < frequency_hz < math.inf):
        raise CanductorError(f"a shaper frequency of {frequency_hz} Hz is impossible; it must be above 0")
    if not 0 <= damping_ratio < 1:
        raise CanductorError(
            f"a damping ratio of {damping_ratio} is impossible; it must be in 0 <= ratio < 1"
        )
    damped = math.sqrt(1 - damping_ratio**2)
    period_s = 1 / (frequency_hz * damped)
    spacing = 0.375 if kind == "mzv" else 0.5
    decay = math.exp(-2 * spacing * math.pi * damping_ratio / damped)
    amplitudes = [a * decay**i for i, a in enumerate(_undamped(kind, tolerance))]
    total = math.fsum(amplitudes)
    amplitudes = [a / total for a in amplitudes]
    times = [i * spacing * period_s for i in range(len(amplitudes))]
    centre = math.fsum(a * t for a, t in zip(amplitudes, times, strict=True))
    return tuple((a, t - centre) for a, t in zip(amplitudes, times, strict=True))


def check_reach(written: str, frequency_hz: float, damping_ratio: float) -> None:
    """Raise ValueError, the end of a sentence, for a shaper that is too long; see ``shaper_impulses``."""
    reach_s = max(abs(time_s) for _, time_s in shaper_impulses(written, frequency_hz, damping_ratio))
    if reach_s > REACH_MAX_S:
        raise ValueError(
            f"{written} of {frequency_hz:g} Hz with a damping ratio of {damping_ratio:g} reaches"
            f" {reach_s:.2f} s far, {REACH_MAX_S:g} s at most; give a higher frequency"
        )


def _undamped(kind: str, v: float) -> tuple[float, ...]:
    """Return amplitudes without damping; they need not sum to 1. V: share of vibration to be let through."""
    if kind == "zv":
        return 1.0, 1.0
    if kind == "zvd":
        return 1.0, 2.0, 1.0
    if kind == "mzv":
        edge = 1 - math.sqrt(0.5)
        return edge, math.sqrt(2) - 1, edge
    if kind == "ei":
        return (1 + v) / 4, (1 - v) / 2, (1 + v) / 4
    if kind == "2hump_ei":
        x = (v * v * (math.sqrt(1 - v * v) + 1)) ** (1 / 3)
        edge = (3 * x * x + 2 * x + 3 * v * v) / (16 * x)
        return edge, 0.5 - edge, 0.5 - edge, edge
    edge = (1 + 3 * v + 2 * math.sqrt(2 * (v + 1) * v)) / 16
    return edge, (1 - v) / 4, (1 + v) / 2 - 2 * edge, (1 - v) / 4, edge

"""Filters of a load cell's readings as second-order sections (pure).

Butterworth filters and notches by the bilinear transform, with cutoff frequencies and widths where they were
wanted (S. J. Orfanidis, "Introduction to Signal Processing", chapter 11).
"""

import math

from nodes.devices.analog_trigger import Section


def low_pass(cutoff_hz: float, rate_hz: float, order: int) -> Section:
    """Return a filter of ORDER 1 or 2 that leaves what is slower than CUTOFF_HZ, below half of RATE_HZ."""
    k, norm, poles = _bilinear(cutoff_hz, rate_hz, order)
    if order == 1:
        return (k * norm, k * norm, 0.0, *poles)
    return (k * k * norm, 2 * k * k * norm, k * k * norm, *poles)


def high_pass(cutoff_hz: float, rate_hz: float, order: int) -> Section:
    """Return a filter of ORDER 1 or 2 that leaves what is faster than CUTOFF_HZ, below half of RATE_HZ."""
    _, norm, poles = _bilinear(cutoff_hz, rate_hz, order)
    return (norm, -norm, 0.0, *poles) if order == 1 else (norm, -2 * norm, norm, *poles)


def _bilinear(cutoff_hz: float, rate_hz: float, order: int) -> tuple[float, float, tuple[float, float]]:
    """Return tan(π·cutoff/rate), the divisor's inverse, and a1, a2."""
    k = math.tan(math.pi * cutoff_hz / rate_hz)
    if order == 1:
        norm = 1 / (1 + k)
        return k, norm, ((k - 1) * norm, 0.0)
    norm = 1 / (1 + math.sqrt(2) * k + k * k)
    return k, norm, (2 * (k * k - 1) * norm, (1 - math.sqrt(2) * k + k * k) * norm)


def notch(at_hz: float, rate_hz: float, quality: float) -> Section:
    """Return a filter that takes out AT_HZ (below half of RATE_HZ), in a band of AT_HZ / QUALITY."""
    width = math.tan(math.pi * at_hz / quality / rate_hz)
    norm = 1 / (1 + width)
    middle = -2 * math.cos(2 * math.pi * at_hz / rate_hz) * norm
    return (norm, middle, norm, middle, (1 - width) * norm)

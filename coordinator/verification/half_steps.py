"""Where a stepper stands, by the rule of steps.h: a boundary is passed only by more than decides a tie."""

import math

import numpy as np
from numpy.typing import NDArray

TIE_STEPS = 2.0**-20
"""A stepper that rests or turns so close to a half step stays where it came from."""


def settled(u: float, standing: int) -> int:
    """Return where a stepper stands that stood at STANDING (steps) and came to U (steps)."""
    up, down = math.floor(u + 0.5 - TIE_STEPS), math.ceil(u - 0.5 + TIE_STEPS)
    return min(max(standing, up), down)


def all_settled(u: NDArray[np.float64], standing: int) -> NDArray[np.int64]:
    """Return where a stepper stands at each of its turns U (steps, in order), having stood at STANDING."""
    up = np.floor(u + (0.5 - TIE_STEPS)).astype(np.int64)
    down = np.ceil(u - (0.5 - TIE_STEPS)).astype(np.int64)
    for i in np.flatnonzero(up != down):
        before = up[i - 1] if i else standing
        up[i] = min(max(before, up[i]), down[i])
    return up

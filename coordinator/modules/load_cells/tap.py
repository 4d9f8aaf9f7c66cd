"""Where the nozzle left the bed, by the force while it was lifted (pure).

While the nozzle is pressed into the bed the force falls in proportion to the way up; from where it leaves the
bed on it stays, but for a drift. The corner of these two lines is found by least squares.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from coordinator.support.lazy_numpy import Numbers, np

LEAST: Final = 12
"""Readings of a lift."""
LEAST_BESIDE: Final = 5
"""Readings of the way before the corner, and after it."""
CANDIDATES: Final = 81
STEPS: Final = 40
"""Of the search between two candidates: each makes it narrower by the golden ratio."""
CLEAR: Final = 1.0
"""One line has to miss the readings, on average, by more than so many times what they scatter by the two."""
LEAST_FALL: Final = 8.0
"""By so many times that a force has to change all the way, to be one."""
_GOLDEN: Final = (math.sqrt(5) - 1) / 2


@dataclass(frozen=True, slots=True)
class Tap:
    """What a lift showed."""

    way_mm: float
    """Up, to where the nozzle left the bed."""
    grams_per_mm: float
    """Of way, while it was pressed into it; below 0 where a press lowers the readings."""
    scatter_g: float
    """Standard deviation of the readings beside the two lines."""


class TapError(Exception):
    """The readings are no lift from a bed; the sentence says what is wrong, without a full stop."""


def find_tap(
    times_s: Sequence[float],
    ways_mm: Sequence[float],
    forces_g: Sequence[float],
    hums_hz: Sequence[float] = (),
) -> Tap:
    """Return the tap of a lift, by when its readings were made, how far up, and their forces.

    HUMS_HZ: frequencies that are in the readings whatever the nozzle does. Raises TapError.
    """
    lift = _Lift(np.array(times_s), np.array(ways_mm), np.array(forces_g), hums_hz)
    if len(lift.ways) < LEAST:
        raise TapError(f"the lift has {len(lift.ways)} readings, and {LEAST} are needed: lift more slowly")
    low, high = float(lift.ways.min()), float(lift.ways.max())
    corners = np.linspace(low, high, CANDIDATES + 2)[1:-1]
    best = int(np.argmin([lift.fit(corner)[0] for corner in corners]))
    corner = lift.narrowed(corners[max(best - 1, 0)], corners[min(best + 1, CANDIDATES - 1)])
    rest, slope = lift.fit(corner)
    scatter_g = float(np.sqrt(rest / (len(lift.ways) - 4)))
    straight, drift = lift.fit(low)
    if np.sqrt(max(straight - rest, 0.0) / len(lift.ways)) <= CLEAR * scatter_g:
        changed_g = abs(drift) * (high - low)
        if changed_g > LEAST_FALL * scatter_g:
            raise TapError(
                f"the force changed by {changed_g:.1f} g all the way: the nozzle did not leave the bed"
            )
        raise TapError(
            f"the force did not fall, readings scatter by {scatter_g:.1f} g: that shows no contact"
        )
    moving = lift.ways[(lift.ways > low) & (lift.ways < high)]
    if min(np.sum(moving < corner), np.sum(moving > corner)) < LEAST_BESIDE:
        where = "at once" if corner < (low + high) / 2 else "only at its end"
        raise TapError(
            f"the nozzle left the bed {where}: a lift has to begin in contact and to end beyond it"
        )
    return Tap(corner, slope, scatter_g)


class _Lift:
    """Readings by time (s), way (mm) and force (g), with hums of these frequencies in them."""

    def __init__(self, times: Numbers, ways: Numbers, forces: Numbers, hums_hz: Sequence[float]) -> None:
        self.ways, self._forces = ways, forces
        waves = [wave(2 * np.pi * hz * times) for hz in hums_hz for wave in (np.sin, np.cos)]
        self._others = [*waves, np.ones_like(ways), ways]

    def fit(self, corner: float) -> tuple[float, float]:
        """Return the sum of squares that two lines with this corner leave, and by how much they bend there.

        With the corner where the lift begins it is one line: then that is its slope.
        """
        ramp = np.maximum(corner - self.ways, 0.0)
        columns = np.stack([ramp, *self._others] if np.any(ramp) else self._others[::-1], axis=1)
        found, *_ = np.linalg.lstsq(columns, self._forces, rcond=None)
        return float(np.sum((columns @ found - self._forces) ** 2)), float(found[0])

    def narrowed(self, low: float, high: float) -> float:
        """Return the best corner between LOW and HIGH, by a golden section search."""
        for _ in range(STEPS):
            width = _GOLDEN * (high - low)
            if self.fit(high - width)[0] < self.fit(low + width)[0]:
                high = low + width
            else:
                low = high - width
        return (low + high) / 2

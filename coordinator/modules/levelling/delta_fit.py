"""Which delta a machine really is, by where its nozzle met a flat bed and by lengths that it printed: pure.

How far each carriage is from its endstop does not depend on what the machine is taken for, so a place is kept
as these three ways. A delta explains them when its nozzle is at the known height there, and as far from
another place as was measured. The fit changes radius, two tower angles (the third one is what the others are
measured from) and the endstops; with lengths also the rods, which heights alone do not show: Gauss-Newton by
differences.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from coordinator.kinematics.base import Point
from coordinator.kinematics.delta import Delta
from coordinator.support.lazy_numpy import Numbers, np

Ways = tuple[float, float, float]
"""How far below its endstop each carriage is, mm."""
ROUNDS: Final = 30
HALVINGS: Final = 10
DIFFERENCE_MM: Final = 1e-4
ENOUGH_MM: Final = 1e-9


@dataclass(frozen=True, slots=True)
class Height:
    """A place at which the nozzle is known to be at Z."""

    z: float
    ways: Ways


@dataclass(frozen=True, slots=True)
class Distance:
    """Two places that are LENGTH apart, mm."""

    length: float
    first: Ways
    second: Ways


def ways_at(delta: Delta, nozzle: Point) -> Ways:
    """Return where the carriages of DELTA are with its nozzle there; ValueError where a rod is too short."""
    a, b, c = (end - at for end, at in zip(delta.endstop_positions, delta.inverse(nozzle), strict=True))
    return (a, b, c)


def nozzle_at(delta: Delta, ways: Ways) -> Point:
    """Return where the nozzle of DELTA is with its carriages there; ValueError where the rods do not meet."""
    return delta.forward(tuple(end - way for end, way in zip(delta.endstop_positions, ways, strict=True)))


def fit_delta(delta: Delta, heights: Sequence[Height], distances: Sequence[Distance] = ()) -> Delta:
    """Return the delta near DELTA that explains HEIGHTS and DISTANCES best; ValueError without one."""
    count = 9 if distances else 6

    def errors(change: Numbers) -> Numbers:
        return _errors(_changed(delta, change), heights, distances)

    change = np.zeros(count)
    off = errors(change)
    for _ in range(ROUNDS):
        slopes = np.empty((len(off), count))
        for i in range(count):
            step = np.zeros(count)
            step[i] = DIFFERENCE_MM
            slopes[:, i] = (errors(change + step) - errors(change - step)) / (2 * DIFFERENCE_MM)
        if np.linalg.matrix_rank(slopes, tol=1e-7) < count:
            raise ValueError("these places do not show all that is to be found; measure at more")
        by = np.linalg.lstsq(slopes, -off, rcond=None)[0]
        for _ in range(HALVINGS):
            try:
                nearer = errors(change + by)
            except ValueError:
                nearer = np.full_like(off, np.inf)
            if nearer @ nearer <= off @ off:
                break
            by = by / 2
        else:
            break
        change, off = change + by, nearer
        if np.abs(by).max() < ENOUGH_MM:
            break
    return _changed(delta, change)


def worst_height_mm(delta: Delta, heights: Sequence[Height]) -> float:
    """Return how far the nozzle of DELTA is from HEIGHTS at the worst of them."""
    return float(np.abs(_errors(delta, heights, ())).max())


def _changed(delta: Delta, change: Numbers) -> Delta:
    """Return DELTA with figures changed by so many mm: radius, angles a, b there, endstops, rods."""
    values = [float(value) for value in change] + [0.0] * (9 - len(change))
    a, b, c = (
        replace(
            tower,
            angle=tower.angle + turned / delta.radius,
            endstop_height=tower.endstop_height + raised,
            rod_length=tower.rod_length + longer,
        )
        for tower, turned, raised, longer in zip(
            delta.towers, (*values[1:3], 0.0), values[3:6], values[6:9], strict=True
        )
    )
    return replace(delta, radius=delta.radius + values[0], towers=(a, b, c))


def _errors(delta: Delta, heights: Sequence[Height], distances: Sequence[Distance]) -> Numbers:
    found = [nozzle_at(delta, height.ways)[2] - height.z for height in heights]
    found += [
        math.dist(nozzle_at(delta, one.first), nozzle_at(delta, one.second)) - one.length for one in distances
    ]
    return np.array(found)

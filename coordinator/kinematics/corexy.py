"""CoreXY: two motors that stand still move the head along X and Y by crossed belts.

Both motors turning the same way move along X, against each other along Y: a = x + y, b = x - y, and so x =
(a + b) / 2, y = (a - b) / 2. Source: I. Moyer, https://corexy.com/theory.html, with the belts scaled so
that a motor alone moves its rail by the same way as on a cartesian machine.
"""

from dataclasses import dataclass

from coordinator.kinematics.axes import AxesKinematics
from coordinator.kinematics.base import linear


@dataclass(frozen=True, slots=True)
class CoreXY(AxesKinematics):
    """Rail x has the motor that moves by x + y, rail y the one that moves by x - y."""

    name = "corexy"
    functions = (linear(x=1, y=1), linear(x=1, y=-1), linear(z=1))

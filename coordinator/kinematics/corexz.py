"""CoreXZ: as CoreXY, with the belts crossed over X and Z.

a = x + z, c = x - z, and so x = (a + c) / 2, z = (a - c) / 2. Source: as corexy.py, with Z for Y.
"""

from dataclasses import dataclass

from coordinator.kinematics.axes import AxesKinematics
from coordinator.kinematics.base import linear


@dataclass(frozen=True, slots=True)
class CoreXZ(AxesKinematics):
    """Rail x has the motor that moves by x + z, rail z the one that moves by x - z."""

    name = "corexz"
    functions = (linear(x=1, z=1), linear(y=1), linear(x=1, z=-1))

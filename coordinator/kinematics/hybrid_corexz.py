"""Hybrid CoreXZ: Z has motors of its own, the belt of X runs over the lifted gantry.

a = x - z, c = z, and so x = a + c. Source: as hybrid_corexy.py, with Z for Y.
"""

from dataclasses import dataclass
from typing import ClassVar

from coordinator.kinematics.axes import AxesKinematics
from coordinator.kinematics.base import linear


@dataclass(frozen=True, slots=True)
class HybridCoreXZ(AxesKinematics):
    """Rail x has the motor that moves by x - z; rail z moves z alone."""

    name = "hybrid_corexz"
    functions = (linear(x=1, z=-1), linear(y=1), linear(z=1))
    second_carriages: ClassVar = {"x": linear(x=1, z=1)}
    """The second belt runs the other way round."""

"""Hybrid CoreXY (Markforged): Y has motors of its own, the belt of X runs over the moving gantry.

The belt that moves the head along X is carried along Y by the gantry: a = x - y, b = y, and so x = a + b.
Source: the way of a belt whose free length is x - y, as described for the Markforged printers.
"""

from dataclasses import dataclass
from typing import ClassVar

from coordinator.kinematics.axes import AxesKinematics
from coordinator.kinematics.base import linear


@dataclass(frozen=True, slots=True)
class HybridCoreXY(AxesKinematics):
    """Rail x has the motor that moves by x - y; rail y moves y alone."""

    name = "hybrid_corexy"
    functions = (linear(x=1, y=-1), linear(y=1), linear(z=1))
    second_carriages: ClassVar = {"x": linear(x=1, y=1)}
    """The second belt runs the other way round."""

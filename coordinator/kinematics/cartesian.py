"""Cartesian: each rail moves one axis. Formulas: none, a rail's position is the axis' position."""

from dataclasses import dataclass
from typing import ClassVar

from coordinator.kinematics.axes import AxesKinematics
from coordinator.kinematics.base import linear


@dataclass(frozen=True, slots=True)
class Cartesian(AxesKinematics):
    """Three axes with motors of their own."""

    name = "cartesian"
    functions = (linear(x=1), linear(y=1), linear(z=1))
    second_carriages: ClassVar = {"x": linear(x=1), "y": linear(y=1)}

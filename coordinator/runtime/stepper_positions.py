"""Positions of the motors, from the steps that their nodes count.

A count alone is no position. When a position is declared (homing ends, another carriage is the head), that of
each rail follows from it, and with the count at that moment the position at a count of 0. From then on the
counts of the nodes give positions, independent of all that the host has planned.
"""

from collections.abc import Mapping, Sequence
from typing import Final

from coordinator.config.model import MachineDescription, StepperDescription
from coordinator.kinematics.base import Point, Weights
from coordinator.kinematics.dual_carriage import CarriageState
from coordinator.kinematics.geometry import fit_point
from coordinator.motion.planner.planner import Position

_XYZ: Final = 3


class StepperPositions:
    """Positions of the machine's motors in mm (rad where they turn something); unknown until declared."""

    def __init__(self, described: MachineDescription) -> None:
        self._described = described
        self._at_zero: dict[str, float] = {}
        self._carriages: CarriageState | None = None
        dual = described.dual_carriage
        self._of_carriage: dict[str, tuple[int, Weights]] = {}
        if dual is not None:
            for number, carriage in enumerate(dual.carriages.carriages):
                self._of_carriage |= {name: (number, weights) for name, weights in carriage.steppers}

    def describe(self, described: MachineDescription) -> None:
        """Take motors to follow what they are DESCRIBED to now; their positions are to be declared then."""
        self._described = described
        self._at_zero = {}

    def declare(
        self,
        position: Position,
        counts: Mapping[str, int],
        carriages: CarriageState | None = None,
        offsets: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Take the axes X Y Z E to be at POSITION when the nodes count COUNTS.

        OFFSETS: how far beyond X, Y and Z their tables have the motors stand.
        """
        self._carriages = carriages
        self._at_zero = {
            stepper.name: self._position(stepper, position, offsets)
            - counts[stepper.name] * stepper.step_distance
            for stepper in self._described.steppers
        }

    def use(self, carriages: CarriageState | None) -> None:
        """Record which carriage is the head."""
        self._carriages = carriages

    def positions(self, counts: Mapping[str, int]) -> dict[str, float]:
        """Return the position of every motor; empty: nothing was declared yet."""
        if not self._at_zero:
            return {}
        return {
            stepper.name: self._at_zero[stepper.name] + counts[stepper.name] * stepper.step_distance
            for stepper in self._described.steppers
        }

    def head(self, positions: Mapping[str, float]) -> Point | None:
        """Return where motors at POSITIONS have the head; None: unknown."""
        if not positions:
            return None
        motors = self._described.motors
        if all(motor.function.linear for motor in motors):
            return self._head_of_sums(positions)
        rails = {rail.axis: rail.steppers[0].name for rail in self._described.rails}
        kinematics = self._described.kinematics
        try:
            return kinematics.forward(tuple(positions[rails[name]] for name in kinematics.rails))
        except ValueError:
            return None  # arms that do not meet: one of them was moved alone

    # ------------------------------------------------------------------------------------------- positions

    def _position(self, stepper: StepperDescription, position: Position, offsets: Sequence[float]) -> float:
        function = stepper.function
        if not function.linear:
            rail = next(rail.axis for rail in self._described.rails if stepper in rail.steppers)
            kinematics = self._described.kinematics
            return kinematics.inverse(position[:_XYZ])[kinematics.rails.index(rail)]
        number, weights = self._of_carriage.get(stepper.name, (0, stepper.weights))
        axes = [at + by for at, by in zip(position, (*offsets, 0.0), strict=True)]
        dual = self._described.dual_carriage
        if dual is not None and self._carriages is not None and stepper.name in self._of_carriage:
            axis = dual.carriages.axis
            axes[axis] = self._carriages.at(position[axis])[number] + offsets[axis]
        return sum(weight * at for weight, at in zip(weights, axes, strict=True))

    def _head_of_sums(self, positions: Mapping[str, float]) -> Point:
        """Return the position that fits all motors of the head best."""
        primary = 0 if self._carriages is None else self._carriages.primary
        rows, sums = [], []
        for motor in self._described.motors:
            number, weights = self._of_carriage.get(motor.name, (primary, motor.weights))
            if number == primary:
                rows.append(weights[:3])
                sums.append(positions[motor.name])
        return fit_point(rows, sums)

"""A machine whose head nothing moves: heaters, fans and sensors alone, perhaps an extruder."""

from dataclasses import dataclass

from coordinator.kinematics.base import Kinematics, Point, StepFunction, WorkSpace


@dataclass(frozen=True, slots=True)
class NoMotion(Kinematics):
    """No rails at all."""

    name = "none"
    rails = ()
    homing_order = ()
    work_space = WorkSpace((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

    def step_functions(self) -> tuple[StepFunction, ...]:
        """Return none."""
        return ()

    def inverse(self, point: Point) -> tuple[float, ...]:
        """Return the positions of no rails."""
        del point
        return ()

    def forward(self, positions: tuple[float, ...]) -> Point:
        """Return the only place that there is."""
        del positions
        return (0.0, 0.0, 0.0)

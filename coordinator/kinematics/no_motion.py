"""A machine whose head nothing moves: heaters, fans and sensors alone, perhaps an extruder."""

from dataclasses import dataclass, field

from coordinator.kinematics.base import Point, StepFunction, WorkSpace


@dataclass(frozen=True, slots=True)
class NoMotion:
    """No rails at all."""

    name = "none"
    rails: tuple[str, ...] = ()
    homing_order: tuple[tuple[str, ...], ...] = ()
    work_space: WorkSpace = field(default_factory=lambda: WorkSpace((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))

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

"""[z_tilt]: two, three or more motors of Z are moved until the bed and the head's plane are parallel."""

from collections.abc import Sequence
from typing import Final

from coordinator.config.model import StepperDescription
from coordinator.config.options import SectionSpec
from coordinator.kinematics.base import Point
from coordinator.modules.base import Build
from coordinator.modules.levelling.motor_levelling import OPTIONS, UNSUPPORTED, MotorLevelling
from coordinator.modules.levelling.points import PlacesOption
from coordinator.modules.levelling.surfaces import Place, fit_plane, rank

POSITIONS: Final = PlacesOption(
    name="z_positions",
    help="where each motor of Z carries the bed or the frame: stepper_z, stepper_z1, …; also outside the bed",
    least=2,
)
POINTS: Final = PlacesOption(name="points", help="where the nozzle is when the bed is probed", least=2)


class ZTilt(MotorLevelling):
    """The section."""

    SPEC = SectionSpec(
        "Levels by the motors of Z, of which each carries a corner or a side",
        (POSITIONS, POINTS, *OPTIONS),
        unsupported=UNSUPPORTED,
    )
    COMMAND = "Z_TILT_ADJUST"
    HELP = "Probe the bed and move each motor of Z until all is level"

    def __init__(self, build: Build) -> None:
        places = build.get(POINTS)
        super().__init__(build, places)
        self._positions = build.get(POSITIONS)
        check_places(build, self._positions, places, self.motors)

    def heights(self, measured: Sequence[Point]) -> list[float]:
        """Return how high the plane through MEASURED is at each motor."""
        plane = fit_plane(measured)
        return [plane.height(position) for position in self._positions]


def check_places(
    build: Build, positions: Sequence[Place], points: Sequence[Place], motors: Sequence[StepperDescription]
) -> None:
    """Raise ConfigError unless POINTS tell how high each of the MOTORS at POSITIONS has to be."""
    if len(positions) != len(motors):
        raise build.reader.bad(POSITIONS, f"{len(positions)} places, but Z has {len(motors)} motors")
    if rank(points) < rank(positions):
        raise build.reader.bad(POINTS, "which lie on one line; the motors need places around it")

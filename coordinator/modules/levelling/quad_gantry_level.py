"""[quad_gantry_level]: four motors at the corners of a gantry are moved until it is parallel to the bed."""

from collections.abc import Sequence
from typing import Final

from coordinator.config.errors import ConfigError
from coordinator.config.options import FloatOption, SectionSpec
from coordinator.kinematics.base import Point
from coordinator.modules.base import Build
from coordinator.modules.levelling.motor_levelling import OPTIONS, UNSUPPORTED, MotorLevelling
from coordinator.modules.levelling.points import PlacesOption
from coordinator.modules.levelling.surfaces import bilinear_heights, rank

CORNERS: Final = PlacesOption(
    name="gantry_corners",
    help="two opposite corners of the gantry, where the belts of stepper_z and of stepper_z2 hold it",
    least=2,
    most=2,
)
POINTS: Final = PlacesOption(
    name="points",
    help="where the nozzle is when the bed is probed: near stepper_z, stepper_z1, stepper_z2, stepper_z3",
    least=4,
    most=4,
)
MAX_ADJUST: Final = FloatOption(
    name="max_adjust",
    help="how far a motor may be moved at once; more is taken for a mistake",
    default=4.0,
    unit="mm",
    above=0,
    maximum=1000,
)
MOTORS: Final = 4


class QuadGantryLevel(MotorLevelling):
    """The section."""

    SPEC = SectionSpec(
        "Levels a gantry by the four motors of Z at its corners",
        (CORNERS, POINTS, MAX_ADJUST, *OPTIONS),
        unsupported=UNSUPPORTED,
    )
    COMMAND = "QUAD_GANTRY_LEVEL"
    HELP = "Probe the bed and move the four motors of Z until the gantry is level"

    def __init__(self, build: Build) -> None:
        places = build.get(POINTS)
        super().__init__(build, places)
        (left, front), (right, back) = build.get(CORNERS)
        self._corners = ((left, front), (left, back), (right, back), (right, front))
        self._max_adjust = build.get(MAX_ADJUST)
        if len(self.motors) != MOTORS:
            raise ConfigError(
                build.place,
                f"[{build.name}] is for four motors of Z, and there are {len(self.motors)}; use [z_tilt]",
            )
        if rank(places) < 2 or rank(self._corners) < 2:
            raise build.reader.bad(POINTS, "which lie on one line; give the four corners of the bed")

    def heights(self, measured: Sequence[Point]) -> list[float]:
        """Return how high the surface through MEASURED is at each corner."""
        return bilinear_heights(measured, self._corners)

    def check(self, adjusts_mm: Sequence[float]) -> str:
        """Refuse what is more than max_adjust."""
        most = max(abs(by) for by in adjusts_mm)
        if most <= self._max_adjust:
            return ""
        return f"a motor would have to move by {most:.3f} mm, more than max_adjust ({self._max_adjust:g} mm)"

"""[bed_tilt]: Z follows a plane that the options say, or BED_TILT_CALIBRATE finds."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from coordinator.config.errors import ConfigError
from coordinator.config.options import FloatOption, SectionSpec
from coordinator.gcode.builtins.machine import follow_surface
from coordinator.gcode.commands import Call, Immediate, Phases, ProgramAction, ProgramContext, Reading
from coordinator.gcode.parser import WordError
from coordinator.kinematics.base import Point
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.compensation.bed_mesh import BedMesh
from coordinator.modules.compensation.reach import beyond_range
from coordinator.modules.levelling.points import OPTIONS, PlacesOption, ProbePoints, how_to_measure
from coordinator.modules.levelling.surfaces import Plane, fit_plane
from coordinator.modules.probes.probe import Measured, Probe
from coordinator.motion.specs import MotionLimits
from coordinator.motion.steps.errors import StepError
from coordinator.motion.steps.surface import Surface
from coordinator.runtime.module_context import ModuleContext

STEEPEST: Final = 0.1
"""mm per mm."""
HIGHEST_MM: Final = 100.0
POINTS: Final = PlacesOption(
    name="points", help="where the nozzle is when BED_TILT_CALIBRATE probes the bed", least=3
)
X_ADJUST: Final = FloatOption(
    name="x_adjust",
    help="how much higher the bed is per mm of X; SAVE_CONFIG writes all three",
    default=0.0,
    unit="mm/mm",
    minimum=-STEEPEST,
    maximum=STEEPEST,
)
Y_ADJUST: Final = FloatOption(
    name="y_adjust",
    help="how much higher it is per mm of Y",
    default=0.0,
    unit="mm/mm",
    minimum=-STEEPEST,
    maximum=STEEPEST,
)
Z_ADJUST: Final = FloatOption(
    name="z_adjust",
    help="how high it is at X = Y = 0",
    default=0.0,
    unit="mm",
    minimum=-HIGHEST_MM,
    maximum=HIGHEST_MM,
)


@dataclass(frozen=True, slots=True)
class Tilt:
    """A plane: X and Y in mm per mm, Z in mm at X = Y = 0."""

    x: float
    y: float
    z: float

    def height(self, x: float, y: float) -> float:
        """Return the height at X, Y.

        >>> Tilt(0.5, -0.25, 1.0).height(4.0, 8.0)
        1.0
        """
        return self.x * x + self.y * y + self.z

    @classmethod
    def of(cls, plane: Plane) -> "Tilt":
        """Return PLANE."""
        return cls(plane.slope_x, plane.slope_y, plane.height((0.0, 0.0)))

    def surface(self, limits: MotionLimits) -> Surface:
        """Return it as far as LIMITS let the head go; raises StepError where it is too steep or high."""
        if wrong := beyond_range(limits, lambda at: (*at[:2], at[2] + self.height(*at[:2]))):
            raise StepError(f"the tilt is refused: {wrong}; correct position_endstop of Z first")
        low, high = limits.position_min[:2], limits.position_max[:2]
        nodes = [
            [(self.height(x, y), self.x, self.y, 0.0) for x in (low[0], high[0])] for y in (low[1], high[1])
        ]
        return Surface((low[0], low[1]), (high[0] - low[0], high[1] - low[1]), nodes)


class BedTilt(Module):
    """The section."""

    SPEC = SectionSpec("Z follows a tilted bed", (X_ADJUST, Y_ADJUST, Z_ADJUST, POINTS, *OPTIONS))

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._place = build.place
        self._limits = build.machine.limits
        places = build.find(POINTS)
        self._points = ProbePoints(build, () if places is None else places)
        self._probe: Probe | None = None
        self._tilt = Tilt(build.get(X_ADJUST), build.get(Y_ADJUST), build.get(Z_ADJUST))
        try:
            build.surface = self._tilt.surface(self._limits)
        except StepError as error:
            raise ConfigError(build.place, f"[{self.name}]: {error}") from None
        build.add_command(
            "BED_TILT_CALIBRATE", "Probe the bed and let Z follow its plane", self._read_calibrate
        )

    def link(self, modules: Modules) -> None:
        """Find the probe, without which the bed is probed by hand; raises ConfigError."""
        if next(modules.of(BedMesh), None) is not None:
            raise ConfigError(
                self._place, f"[{self.name}] and [bed_mesh] both say what Z follows; remove one of them"
            )
        self._probe = self._points.find_probe(modules)

    def added_mm(self, place: Point) -> float:
        """Return how much higher the motors are at a planned PLACE because of the tilt."""
        return self._tilt.height(*place[:2])

    def _read_calibrate(self, call: Call) -> Reading:
        how = how_to_measure(call, self._probe)
        by = None if how is None or self._probe is None else (self._probe, how)
        if not self._points.places:
            raise WordError(f"{call.command.name} needs points of [{self.name}]")
        self._points.check(call, None if by is None else by[0])

        def found(job: ProgramContext, measured: list[Measured]) -> Iterator[Reading]:
            del job
            yield from self._found(call, Tilt.of(fit_plane([one.bed for one in measured])))

        return Phases(lambda job: self._points.collect(job, call, by, found))

    def _found(self, call: Call, tilt: Tilt) -> Iterator[Reading]:
        try:
            surface = tilt.surface(self._limits)
        except StepError as error:
            raise WordError(f"{call.command.name} failed: {error}") from None
        yield ProgramAction(lambda job: follow_surface(job, surface))
        texts = {
            X_ADJUST.name: f"{tilt.x:.8f}",
            Y_ADJUST.name: f"{tilt.y:.8f}",
            Z_ADJUST.name: f"{tilt.z:.6f}",
        }

        def keep() -> None:
            self._tilt = tilt
            if (live := self._live) is not None:
                live.soon_on_loop(lambda: _save(live, self.name, texts))

        said = ", ".join(f"{option}: {text}" for option, text in texts.items())
        yield Immediate((f"{said}; SAVE_CONFIG writes them",), keep)


def _save(live: ModuleContext, section: str, texts: Mapping[str, str]) -> None:
    for option, text in texts.items():
        live.save(section, option, text)

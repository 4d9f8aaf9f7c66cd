"""[z_tilt_ng]: as [z_tilt]; it also finds where the motors carry the bed, and how uneven its places are.

Z_TILT_CALIBRATE measures the points and further ones, and keeps how far each point is from the plane through
all of them: with these offsets a few points level as well as many. Z_TILT_AUTODETECT raises one motor after
the other by DELTA. The bed then tilts by as much as 1 at that motor and 0 at the others, times DELTA: where
these planes have those heights, there the motors are.
"""

from collections.abc import Awaitable, Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeVar

from coordinator.config.options import BadValue, FloatOption, IntOption, Option, SectionSpec
from coordinator.gcode.commands import AtStandstill, Call, Immediate, Phases, ProgramContext, Reading
from coordinator.gcode.events import Done
from coordinator.gcode.parameters import bounded
from coordinator.gcode.parser import Command, WordError
from coordinator.kinematics.base import Point
from coordinator.modules.base import Build
from coordinator.modules.levelling.motor_levelling import OPTIONS, SMALL_MM, UNSUPPORTED, MotorLevelling
from coordinator.modules.levelling.points import PlacesOption, how_to_measure
from coordinator.modules.levelling.surfaces import Place, Plane, fit_plane
from coordinator.modules.levelling.z_tilt import POINTS, POSITIONS, check_places
from coordinator.modules.probes.probe import Measuring, Probe
from coordinator.runtime.machine import MachineStopped
from coordinator.support.lazy_numpy import np
from nodes.support.errors import CanductorError

T = TypeVar("T")

LARGEST_MM: Final = 10.0
"""Of an offset, and of a tilt."""
RUNS_MAX: Final = 30
"""Of a mean that does not settle."""
MOTORS: Final = 3
"""As many places does a plane that tilts give away."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OffsetsOption(Option[tuple[float, ...]]):
    """Heights in mm, separated by commas or on lines of their own."""

    def parse(self, text: str) -> tuple[float, ...]:
        """Return them."""
        number = FloatOption(name="", help="", minimum=-LARGEST_MM, maximum=LARGEST_MM)
        words = text.replace("\n", ",").split(",")
        if not (offsets := tuple(number.parse(word.strip()) for word in words if word.strip())):
            raise BadValue
        return offsets

    def rule(self) -> str:
        """Return what is allowed."""
        return f"heights of -{LARGEST_MM:g} to {LARGEST_MM:g} mm, separated by commas"

    def stand_in(self) -> tuple[float, ...]:
        """Return any heights."""
        return (0.0, 0.0)


OFFSETS: Final = OffsetsOption(
    name="z_offsets", help="what is added to the height of each of points; SAVE_CONFIG writes it"
)
EXTRA: Final = PlacesOption(name="extra_points", help="further places that Z_TILT_CALIBRATE probes")
AVERAGING: Final = IntOption(
    name="averaging_len",
    help="how many of the last runs a mean is of; both commands run until it settles",
    default=3,
    minimum=1,
    maximum=RUNS_MAX - 1,
)
DELTA: Final = FloatOption(
    name="autodetect_delta",
    help="by how much Z_TILT_AUTODETECT raises each motor",
    default=1.0,
    unit="mm",
    minimum=0.1,
    maximum=LARGEST_MM,
)


@dataclass(frozen=True, slots=True)
class _Runs:
    """How a command measures again and again."""

    command: Command
    probe: Probe
    how: Measuring
    averaging: int
    """Of how many runs the mean is."""


class ZTiltNg(MotorLevelling):
    """The section."""

    SPEC = SectionSpec(
        "Levels by the motors of Z, and finds where they are",
        (POSITIONS, POINTS, OFFSETS, EXTRA, AVERAGING, DELTA, *OPTIONS),
        unsupported=UNSUPPORTED,
    )
    COMMAND = "Z_TILT_ADJUST"
    HELP = "Probe the bed and move each motor of Z until all is level"

    def __init__(self, build: Build) -> None:
        self._places = build.get(POINTS)
        super().__init__(build, self._places)
        self._positions = build.find(POSITIONS)
        if self._positions is not None:
            check_places(build, self._positions, self._places, self.motors)
        self._offsets = build.find(OFFSETS) or (0.0,) * len(self._places)
        if len(self._offsets) != len(self._places):
            raise build.reader.bad(
                OFFSETS, f"{len(self._offsets)} heights, but there are {len(self._places)} points"
            )
        self._extra = build.find(EXTRA) or ()
        self._averaging, self._delta = build.get(AVERAGING), build.get(DELTA)
        build.add_command(
            "Z_TILT_CALIBRATE", "Find how uneven the points of Z_TILT_ADJUST are", self._read_calibrate
        )
        build.add_command("Z_TILT_AUTODETECT", "Find where the motors of Z are", self._read_autodetect)

    def corrected(self, measured: Sequence[Point]) -> list[Point]:
        """Return MEASURED points with the offsets of their places."""
        return [(x, y, z + by) for (x, y, z), by in zip(measured, self._offsets, strict=True)]

    def heights(self, measured: Sequence[Point]) -> list[float]:
        """Return how high the plane through MEASURED is at each motor; raises WordError."""
        if self._positions is None:
            raise WordError(
                f"{self.COMMAND} needs z_positions of [{self.name}]; Z_TILT_AUTODETECT finds them"
            )
        plane = fit_plane(measured)
        return [plane.height(position) for position in self._positions]

    # --------------------------------------------------------------------------------------------- commands

    def _read_calibrate(self, call: Call) -> Reading:
        runs = self._runs(call, "AVGLEN")

        def run(job: ProgramContext) -> Iterator[Reading]:
            places = (*self._places, *self._extra)
            found = yield from self._measure_often(job, runs, places)
            if found is not None:
                yield self._keep_offsets(fit_plane(found), found)

        return Phases(run)

    def _read_autodetect(self, call: Call) -> Reading:
        runs = self._runs(call, "AVGLEN", "DELTA")
        given = call.parameters("AVGLEN", "DELTA", "METHOD")
        delta = bounded(call.command, given, "DELTA", self._delta, low=0.1, high=LARGEST_MM)
        if len(self.motors) != MOTORS:
            raise WordError(
                f"{call.command.name} is for {MOTORS} motors of Z, and there are {len(self.motors)}; write"
                " z_positions by hand"
            )

        def run(job: ProgramContext) -> Iterator[Reading]:
            self.applied = False
            found = yield from self._measure_often(job, runs, self._places)
            if found is None:
                return
            level, tilted = fit_plane(found), []
            for number, motor in enumerate(self.motors):
                by = [delta if number == other else 0.0 for other in range(MOTORS)]
                raised = f"{motor.name} is raised by {delta:g} mm"
                yield Immediate((raised,))
                yield self._raise(job, runs, by)
                measuring = self._measure_often(job, runs, self._places)
                measured = yield from noted(measuring, f"{raised} and stays so: level before you print")
                yield self._raise(job, runs, [-one for one in by])
                if measured is None:
                    return
                tilted.append(fit_plane(measured))
            yield self._keep_positions(call.command, find_motors(level, tilted, delta))
            yield self._keep_offsets(level, found)

        return Phases(run)

    def _runs(self, call: Call, *names: str) -> _Runs:
        """Return how CALL measures, whose parameters are NAMES; raises WordError."""
        how = how_to_measure(call, self.probe)
        given = call.parameters(*names, "METHOD")
        if how is None or self.probe is None:
            raise WordError(f"{call.command.name} measures many times; it needs a probe")
        averaging = bounded(call.command, given, "AVGLEN", self._averaging, low=1, high=RUNS_MAX - 1)
        self.check_call(call, self.probe)
        return _Runs(call.command, self.probe, how, round(averaging))

    def _raise(self, job: ProgramContext, runs: _Runs, by: Sequence[float]) -> Reading:
        call = job.call(runs.command)
        return AtStandstill(lambda: self.adjust(call, by, 0.0, runs.how.lift_speed))

    def _measure_often(
        self, job: ProgramContext, runs: _Runs, places: Sequence[Place]
    ) -> Generator[Reading, None, list[Point] | None]:
        """Measure PLACES until the mean of the last runs settles; return it. None: it is only planned."""
        heights: list[list[float]] = []
        mean, change = None, np.inf
        while True:
            found = yield from self.points.measure(job, runs.command, runs.probe, runs.how, places=places)
            if found is None:
                return None
            heights.append([one.bed[2] for one in found])
            now = np.mean(heights[-runs.averaging :], axis=0)
            if mean is not None:
                changed = float(np.max(np.abs(now - mean)))
                if changed <= SMALL_MM or changed >= change or len(heights) == RUNS_MAX:
                    return [(*one.bed[:2], float(z)) for one, z in zip(found, now, strict=True)]
                change = changed
            if len(heights) >= runs.averaging:
                mean = now

    # ------------------------------------------------------------------------------------------ what is kept

    def _keep_offsets(self, plane: Plane, found: Sequence[Point]) -> Reading:
        """Return what keeps how far each of the points is from PLANE."""
        offsets = tuple(plane.height((x, y)) - z for x, y, z in found[: len(self._places)])
        text = ", ".join(f"{offset:.6f}" for offset in offsets)

        def keep() -> None:
            self._offsets = offsets
            self._save(OFFSETS.name, text)

        return Immediate((f"{OFFSETS.name}: {text}; SAVE_CONFIG writes them",), keep)

    def _keep_positions(self, command: Command, positions: Sequence[Place] | None) -> Reading:
        """Return what keeps where the motors are."""
        if positions is None:
            raise WordError(
                f"{command.name} failed: the bed does not tilt in two directions; are the motors in one line?"
            )
        lines = [f"{x:.3f}, {y:.3f}" for x, y in positions]

        def keep() -> None:
            self._positions = tuple(positions)
            self._save(POSITIONS.name, "\n" + "\n".join(lines))

        return Immediate((f"{POSITIONS.name}: {'; '.join(lines)}; SAVE_CONFIG writes them",), keep)

    def _save(self, option: str, text: str) -> None:
        if (live := self._live) is not None:
            live.soon_on_loop(lambda: live.save(self.name, option, text))


def noted(phases: Generator[Reading, None, T], note: str) -> Generator[Reading, None, T]:
    """Go through PHASES, of which an error at standstill ends with NOTE."""

    def with_note(act: Callable[[], Awaitable[Done | None]]) -> Callable[[], Awaitable[Done | None]]:
        async def noting() -> Done | None:
            try:
                return await act()
            except MachineStopped:
                raise
            except CanductorError as error:
                raise CanductorError(f"{error}; {note}") from error

        return noting

    while True:
        try:
            phase = next(phases)
        except StopIteration as end:
            found: T = end.value
            return found
        if isinstance(phase, AtStandstill):
            phase = replace(phase, perform=with_note(phase.perform))
        yield phase


def find_motors(level: Plane, tilted: Sequence[Plane], delta: float) -> list[Place] | None:
    """Return where three motors are that were raised by DELTA one after the other; None: it cannot be found.

    LEVEL: the bed before; TILTED: with each of them raised. A raised motor lets the bed seem lower.
    """
    slopes = np.array(
        [((level.slope_x - one.slope_x) / delta, (level.slope_y - one.slope_y) / delta) for one in tilted]
    )
    share = np.array([(level.z - one.z) / delta for one in tilted])
    if np.linalg.matrix_rank(slopes, tol=1e-4) < 2:
        return None
    found = [np.linalg.lstsq(slopes, wanted - share, rcond=None)[0] for wanted in np.eye(len(tilted))]
    return [(level.center[0] + float(x), level.center[1] + float(y)) for x, y in found]

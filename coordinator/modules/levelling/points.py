"""Places that are probed one after the other: the options that name them, and the ways between them."""

from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

from coordinator.config.errors import NotSupported
from coordinator.config.options import BadValue, BoolOption, FloatOption, Option
from coordinator.config.sections.bounds import MAX_POSITION, MAX_SPEED
from coordinator.gcode.builtins.state import go
from coordinator.gcode.commands import Call, Immediate, ProgramAction, ProgramContext, Reading
from coordinator.gcode.parameters import bounded
from coordinator.gcode.parser import Command, WordError, quoted
from coordinator.kinematics.base import Point
from coordinator.modules.base import Build, Modules
from coordinator.modules.levelling.surfaces import Place
from coordinator.modules.probes.manual_probe import ManualProbe
from coordinator.modules.probes.probe import Measured, Measuring, Probe, lift


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacesOption(Option[tuple[Place, ...]]):
    """X and Y of several places, a line each."""

    least: int = 1
    most: int = 1000

    def parse(self, text: str) -> tuple[Place, ...]:
        """Return them."""
        number = FloatOption(name="", help="", minimum=-MAX_POSITION, maximum=MAX_POSITION)
        places = []
        for line in (line.strip() for line in text.splitlines()):
            if not line:
                continue
            words = [word.strip() for word in line.split(",")]
            if len(words) != 2:
                raise BadValue
            places.append((number.parse(words[0]), number.parse(words[1])))
        if not self.least <= len(places) <= self.most:
            raise BadValue
        return tuple(places)

    def rule(self) -> str:
        """Return what is allowed."""
        count = f"{self.least}" if self.least == self.most else f"{self.least} or more"
        return f"{count} places, each X and Y in mm with a comma between them, on a line of its own"

    def stand_in(self) -> tuple[Place, ...]:
        """Return any places."""
        return tuple((float(number), float(number % 2)) for number in range(self.least))

    def setting(self, text: str, value: tuple[Place, ...]) -> object:
        """Return them as lists."""
        del text
        return [list(place) for place in value]


TRAVEL_SPEED: Final = FloatOption(
    name="speed",
    help="speed of the ways between places",
    default=50.0,
    unit="mm/s",
    above=0,
    maximum=MAX_SPEED,
)
HEIGHT: Final = FloatOption(
    name="horizontal_move_z",
    help="height of the ways between places",
    default=5.0,
    unit="mm",
    minimum=-MAX_POSITION,
    maximum=MAX_POSITION,
)
BY_PROBE: Final = BoolOption(
    name="use_probe_xy_offsets",
    help="whether the places are those of the probe; else those of the nozzle",
    default=False,
)
OPTIONS: Final[tuple[Option[Any], ...]] = (TRAVEL_SPEED, HEIGHT, BY_PROBE)


Found = Callable[[ProgramContext, list[Measured]], Iterator[Reading]]
"""What follows when all places are measured."""
PROBES: Final = (
    *("probe", "bltouch", "smart_effector", "probe_eddy_current", "load_cell_probe", "dockable_probe"),
    *("cartographer", "beacon", "scanner"),
)
"""First words of sections of probes, of which some may not act yet."""
AUTOMATIC: Final = ("automatic", "scan", "rapid_scan")
MANUAL: Final = "manual"


def how_to_measure(call: Call, probe: Probe | None) -> Measuring | None:
    """Return how CALL measures by PROBE, None: by hand, as METHOD says; raises WordError.

    Without METHOD it is by the probe, where there is one.
    """
    command = call.command
    written = call.parameters("METHOD").get("METHOD", MANUAL if probe is None else AUTOMATIC[0])
    method = written.lower()
    if method == MANUAL:
        return None
    if method not in AUTOMATIC:
        raise WordError(f"METHOD of {command.name} is {quoted(written)}; automatic and manual are possible")
    if probe is None:
        raise WordError(f"METHOD of {command.name} is {method}, and there is no probe; give METHOD=manual")
    return replace(probe.how(command), method=method)


class ProbePoints:
    """The PLACES of a section, with its OPTIONS."""

    def __init__(
        self, build: Build, places: Sequence[Place] = (), *, by_probe: BoolOption = BY_PROBE
    ) -> None:
        self.places = tuple(places)
        self._manual = build.shared(ManualProbe)
        self._place = build.place
        self._left_out = [name for name in build.unsupported if name.partition(" ")[0] in PROBES]
        self.speed, self._height = build.get(TRAVEL_SPEED), build.get(HEIGHT)
        """Of the ways, mm/s, and how high they are, mm."""
        self._by_probe = build.get(by_probe)

    def find_probe(self, modules: Modules) -> Probe | None:
        """Return the probe, None where there is none; raises NotSupported for one that does not act yet.

        A program that measures by such a probe must not wait for someone to measure by hand.
        """
        found = next((modules.find(name, Probe) for name in modules.names(Probe)), None)
        if found is None and self._left_out:
            raise NotSupported(self._place, f"it needs [{self._left_out[0]}], which is not supported yet")
        return found

    def height(self, command: Command) -> float:
        """Return how high the head travels by COMMAND, or as configured; raises WordError."""
        given = command.only_parameters(("HORIZONTAL_MOVE_Z",))
        return bounded(
            command, given, "HORIZONTAL_MOVE_Z", self._height, low=-MAX_POSITION, high=MAX_POSITION
        )

    def measure(
        self,
        job: ProgramContext,
        command: Command,
        probe: Probe,
        how: Measuring,
        *,
        height: float | None = None,
        places: Sequence[Place] | None = None,
    ) -> Generator[Reading, None, list[Measured] | None]:
        """Measure all places (or PLACES) in turn; None: it is only planned. It ends at travel HEIGHT."""
        height = self.height(command) if height is None else height
        if probe.scans and how.method != AUTOMATIC[0]:
            travels = [
                partial(self.travel, job, probe, place, height, how.lift_speed)
                for place in (self.places if places is None else places)
            ]
            yield from probe.deploy(job, command)
            scanned = yield from probe.scan(job, command, how, travels)
            if scanned is not None:
                yield from probe.stow(job, command)
            return scanned
        found = []
        yield from probe.deploy(job, command)
        for place in self.places if places is None else places:
            yield from self.travel(job, probe, place, height, how.lift_speed)
            measured = yield from probe.measure(job, command, how)
            if measured is None:
                return None
            found.append(measured)
        yield from lift(job, height, how.lift_speed)
        yield from probe.stow(job, command)
        return found

    def check(self, call: Call, probe: Probe | None) -> None:
        """Raise WordError where nothing can be measured, by PROBE or else by hand."""
        self.height(call.command)
        if probe is None:
            self._manual.check_free(call)
        else:
            probe.check(call)

    def collect(
        self,
        job: ProgramContext,
        call: Call,
        by: tuple[Probe, Measuring] | None,
        found: Found,
        *,
        places: Sequence[Place] | None = None,
    ) -> Iterator[Reading]:
        """Measure all places (or PLACES) in turn, then go on with FOUND; BY a probe, None: by hand.

        By hand the nozzle goes to each place, ACCEPT takes the height and leads to the next one.
        """
        places = self.places if places is None else places
        if by is None:
            yield from self._look_for(job, call.command, tuple(places), [], found)
            return
        measured = yield from self.measure(job, call.command, *by, places=places)
        if measured is not None:
            yield from found(job, measured)

    def _look_for(
        self,
        job: ProgramContext,
        command: Command,
        places: tuple[Place, ...],
        known: list[Measured],
        found: Found,
    ) -> Iterator[Reading]:
        yield from lift(job, self.height(command), self.speed)
        if len(known) == len(places):
            yield from found(job, known)
            return
        x, y = places[len(known)]
        yield ProgramAction(lambda job: go(job, [x, y, *job.planner.toolhead_position[2:]], self.speed))
        yield Immediate((f"place {len(known) + 1} of {len(places)}: {x:.3f},{y:.3f}",))

        def accepted(job: ProgramContext, at: Point) -> Iterator[Reading]:
            yield from self._look_for(job, command, places, [*known, Measured(at, at)], found)

        yield self._manual.follow(job.call(command), accepted)

    def travel(
        self, job: ProgramContext, probe: Probe, place: Place, height: float, lift_speed: float
    ) -> Iterator[Reading]:
        """Bring the nozzle, or the probe, above PLACE."""
        yield from lift(job, height, lift_speed)
        dx, dy = probe.offset[:2] if self._by_probe else (0.0, 0.0)
        x, y, speed = place[0] - dx, place[1] - dy, self.speed

        def act(job: ProgramContext) -> bool:
            return go(job, [x, y, *job.planner.toolhead_position[2:]], speed)

        yield ProgramAction(act)

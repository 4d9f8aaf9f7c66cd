"""What all probes have in common: a part of the head that finds how high the bed is.

A measurement is a sequence of phases (gcode/commands.py): the lines of ``activate_gcode``, the way down until
the probe triggers, the lines of ``deactivate_gcode``, a lift, and that again until there are enough samples.
Modules that level something ask for places by ``deploy``, ``measure`` and ``stow``.
"""

from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final

from coordinator.config.errors import ConfigError
from coordinator.config.options import (
    BoolOption,
    ChoiceOption,
    FloatOption,
    GCodeOption,
    IntOption,
    Option,
)
from coordinator.config.pins import PinOption
from coordinator.config.sections.bounds import MAX_SPEED
from coordinator.config.sections.probe import OFFSETS, PIN, Z_OFFSET
from coordinator.gcode.builtins.state import go
from coordinator.gcode.commands import (
    AtStandstill,
    Call,
    Immediate,
    Lines,
    ProgramAction,
    ProgramContext,
    Reading,
)
from coordinator.gcode.events import Done
from coordinator.gcode.parameters import bounded
from coordinator.gcode.parser import Command, WordError, quoted
from coordinator.kinematics.base import Point
from coordinator.modules.base import Build, Modules
from coordinator.modules.compensation.skew_correction import Skew, Skews
from coordinator.modules.homing.virtual_endstop import ProbeEndstop
from coordinator.modules.probes.samples import AVERAGE, MEDIAN, SampleRules, SampleSeries
from coordinator.modules.programs.gcode_macro import GCodeTemplate
from coordinator.runtime.module_context import ModuleContext
from coordinator.runtime.moves.homing import HomingError
from coordinator.runtime.moves.probing import Contact, ProbingMove, downwards, place_by_steps
from coordinator.support.values import Value
from nodes.support.errors import CanductorError

SPEED: Final = FloatOption(
    name="speed", help="speed of the way down", default=5.0, unit="mm/s", above=0, maximum=MAX_SPEED
)
LIFT_SPEED: Final = FloatOption(
    name="lift_speed",
    help="speed of the way up between samples; by default speed",
    unit="mm/s",
    above=0,
    maximum=MAX_SPEED,
)
SAMPLES: Final = IntOption(name="samples", help="how often each place is measured", default=1, minimum=1)
RETRACT: Final = FloatOption(
    name="sample_retract_dist",
    help="how far the head is lifted between samples",
    default=2.0,
    unit="mm",
    above=0,
    maximum=1000,
)
RESULT: Final = ChoiceOption(
    name="samples_result", help="what the samples become", default=AVERAGE, choices=(AVERAGE, MEDIAN)
)
TOLERANCE: Final = FloatOption(
    name="samples_tolerance",
    help="how far the samples of a place may be apart",
    default=0.1,
    unit="mm",
    minimum=0,
    maximum=1000,
)
RETRIES: Final = IntOption(
    name="samples_tolerance_retries",
    help="how often all samples of a place are taken again where they are further apart",
    default=0,
    minimum=0,
)
DROP_FIRST: Final = BoolOption(
    name="drop_first_result", help="whether the first measurement of a place does not count", default=False
)
ACTIVATE: Final = GCodeOption(name="activate_gcode", help="what is done before the way down", default="")
DEACTIVATE: Final = GCodeOption(name="deactivate_gcode", help="what is done after it", default="")
EACH: Final = BoolOption(
    name="deactivate_on_each_sample",
    help="whether to run these for each sample, not once per command",
    default=True,
)
PARAMETERS: Final = (
    *("PROBE_SPEED", "LIFT_SPEED", "SAMPLES", "SAMPLE_RETRACT_DIST", "SAMPLES_TOLERANCE"),
    *("SAMPLES_TOLERANCE_RETRIES", "SAMPLES_RESULT"),
)
"""Of the commands that measure, in the place of options."""
SAME_MM: Final = 1e-6


class NotReadyError(HomingError):
    """A probe could not be deployed or put away."""


@dataclass(frozen=True, slots=True)
class Measuring:
    """How a command measures."""

    speed: float
    lift_speed: float
    retract_mm: float
    rules: SampleRules
    method: str = "automatic"
    """Or ``scan``, ``rapid_scan``: for a probe that ``scans``."""


@dataclass(frozen=True, slots=True)
class Measured:
    """What was found at one place, mm."""

    nozzle: Point
    """X and Y of the nozzle, and its height when the probe triggered."""
    bed: Point
    """Where the probe found the bed, and how high it is there."""


Phase = Generator[Reading, None, Measured | None]


MEASURING_OPTIONS: Final[tuple[Option[Any], ...]] = (
    *OFFSETS,
    Z_OFFSET,
    SPEED,
    LIFT_SPEED,
    SAMPLES,
    RETRACT,
    RESULT,
    TOLERANCE,
    RETRIES,
    DROP_FIRST,
)
"""Of every probe."""
LINE_OPTIONS: Final[tuple[Option[Any], ...]] = (ACTIVATE, DEACTIVATE, EACH)
"""Of probes that are deployed by g-code."""


class Probe(ProbeEndstop):
    """The probe; PROBE and the like are in probe_commands.py, the kinds of probes in files of their own.

    A kind declares INPUT; one that has to be deployed or waited for overrides ``touching``, or with
    ``stays_deployed`` also ``begin`` and ``finish``; all of them run at standstill.
    """

    SHOWN_AS = "probe"
    INPUT: ClassVar[PinOption | None] = PIN
    """Its input; None: it has none."""
    HAS_LINES: ClassVar[bool] = True
    """Whether it has the options of LINE_OPTIONS."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        if self.INPUT is not None:
            build.pin(self.INPUT)
        self.offset: Point = (*self.side_offset(build), self.trigger_height(build))
        """From the nozzle: X, Y, and how high that is when the probe triggers, mm."""
        speed = build.get(SPEED)
        self.measuring = Measuring(
            speed,
            build.get_or(LIFT_SPEED, speed),
            build.get(RETRACT),
            SampleRules(
                samples=build.get(SAMPLES),
                result=build.get(RESULT),
                tolerance_mm=build.get(TOLERANCE),
                retries=build.get(RETRIES),
                drop_first=build.get(DROP_FIRST),
            ),
        )
        self._activate = GCodeTemplate(build, ACTIVATE) if self.HAS_LINES else None
        self._deactivate = GCodeTemplate(build, DEACTIVATE) if self.HAS_LINES else None
        self._each = not self.HAS_LINES or build.get(EACH)
        self.corrections: list[Callable[[float, float], float]] = []
        """What is added to a measured height, mm, by X and Y of the probe."""
        if downwards(build.machine) is None:
            raise ConfigError(
                build.place,
                f"[{build.name}] has no use on a machine of kinematics {build.machine.kinematics.name}: its"
                " motors do not lower the head by the same way everywhere; remove it",
            )
        self._lowest_z = build.machine.limits.position_min[2]
        self._live: ModuleContext | None = None
        self._skews: Skews | None = None
        self.last_query = False
        self._last: Measured | None = None

    def side_offset(self, build: Build) -> tuple[float, float]:
        """Return how far it is from the nozzle along X and Y, mm; raises ConfigError."""
        x, y = (build.get(option) for option in OFFSETS)
        return x, y

    def trigger_height(self, build: Build) -> float:
        """Return how high the nozzle is when it triggers, mm; raises ConfigError."""
        return build.get(Z_OFFSET)

    def link(self, modules: Modules) -> None:
        """Find what makes X and Y of programs others than those of the motors."""
        self._skews = modules.find("skew_correction", Skews)

    async def connect(self, live: ModuleContext) -> None:
        """Take over the machine."""
        self._live = live

    def status(self) -> Mapping[str, Value]:
        """Report what was found last."""
        bed = (0.0, 0.0, 0.0) if self._last is None else self._last.bed
        return {
            "name": self.name,
            "last_query": self.last_query,
            "last_probe_position": list(bed),
            "last_z_result": 0.0 if self._last is None else self._last.nozzle[2],
        }

    def keep(self, found: Measured) -> None:
        """Show FOUND as what PROBE found last."""
        self._last = found

    # ---------------------------------------------------------------------------------- as endstop of Z

    @property
    def has_lines(self) -> bool:
        """Whether it is activated or deactivated by g-code."""
        return any(lines is not None and lines.text.strip() for lines in (self._activate, self._deactivate))

    def lines_before(self, call: Call) -> Lines:
        """Return the lines that activate it."""
        return Lines("") if self._activate is None else self._activate.lines(call, {})

    def lines_after(self, call: Call) -> Lines:
        """Return the lines that deactivate it."""
        return Lines("") if self._deactivate is None else self._deactivate.lines(call, {})

    # ------------------------------------------------------------------------------------------ measuring

    def how(self, command: Command) -> Measuring:
        """Return how COMMAND measures: as configured, but for its PARAMETERS; raises WordError."""
        given = command.only_parameters(PARAMETERS)
        own, rules = self.measuring, self.measuring.rules
        result = given.get("SAMPLES_RESULT", rules.result).lower()
        if result not in (AVERAGE, MEDIAN):
            raise WordError(
                f"SAMPLES_RESULT of {command.name} is {quoted(result)}; {AVERAGE} or {MEDIAN} is possible"
            )

        def read(key: str, default: float, low: float, high: float) -> float:
            return bounded(command, given, key, default, low=low, high=high)

        return Measuring(
            read("PROBE_SPEED", own.speed, 1e-3, MAX_SPEED),
            read("LIFT_SPEED", own.lift_speed, 1e-3, MAX_SPEED),
            read("SAMPLE_RETRACT_DIST", own.retract_mm, 1e-3, 1000),
            replace(
                rules,
                samples=round(read("SAMPLES", rules.samples, 1, 10_000)),
                result=result,
                tolerance_mm=read("SAMPLES_TOLERANCE", rules.tolerance_mm, 0, 1000),
                retries=round(read("SAMPLES_TOLERANCE_RETRIES", rules.retries, 0, 10_000)),
            ),
        )

    def check(self, call: Call) -> None:
        """Raise WordError where nothing can be measured."""
        if "Z" not in call.homed:
            raise WordError(f"{call.command.name} comes before Z is homed; home with G28 first")

    def check_offset(self, command: Command) -> None:
        """Raise WordError where COMMAND, which finds a z_offset, does not apply to this kind of probe."""

    async def is_triggered(self) -> bool:
        """Return whether its node sees it triggered now; raises CanductorError."""
        machine = self.live.machine
        described = machine.description.probe
        assert described is not None
        node = self.live.node(machine.devices.endstop_node(described.rail))
        return (await machine.devices.endstops[described.rail.axis].state(node)).pressed

    @property
    def stays_deployed(self) -> bool:
        """Whether it stays deployed between the measurements of a command, from ``begin`` to ``finish``."""
        return False

    async def begin(self) -> None:
        """Begin to measure the places of one command, at standstill."""

    async def finish(self) -> None:
        """End what ``begin`` began, at standstill; raises CanductorError."""

    def deploy(self, job: ProgramContext, command: Command) -> Iterator[Reading]:
        """Make ready for the places of COMMAND."""
        if not self._each:
            yield from self._run_lines(job, command, self._activate)
        if self.stays_deployed:
            yield AtStandstill(self.begin)

    def stow(self, job: ProgramContext, command: Command) -> Iterator[Reading]:
        """Put away what ``deploy`` made ready."""
        if self.stays_deployed:
            yield AtStandstill(self.finish)
        if not self._each:
            yield from self._run_lines(job, command, self._deactivate)

    def measure(self, job: ProgramContext, command: Command, how: Measuring) -> Phase:
        """Measure where the head is, which is left where the probe triggered; None: it is only planned."""
        series = SampleSeries(how.rules)
        while True:
            contact = yield from self.touch(job, command, how)
            if contact is None:
                return None
            height = contact.trigger_z + self._correction(contact)
            found = self._found(contact, height)
            yield Immediate((f"probe at {found.bed[0]:.3f},{found.bed[1]:.3f} is z={height:.6f}",))
            if remark := series.take(height):
                yield Immediate((remark,))
            if series.is_complete:
                break
            yield from lift(job, contact.position[2] + how.retract_mm, how.lift_speed)
        if series.failed:
            yield from self.stow(job, command)
            raise WordError(f"{command.name} failed: {series.failed}")
        return self._found(contact, series.result)

    @property
    def scans(self) -> bool:
        """Whether it measures at travel height, by ``scan``."""
        return False

    def scan(
        self,
        job: ProgramContext,
        command: Command,
        how: Measuring,
        travels: Sequence[Callable[[], Iterator[Reading]]],
    ) -> Generator[Reading, None, list[Measured] | None]:
        """Measure where each of TRAVELS leads, at travel height; None: it is only planned."""
        raise NotImplementedError

    def touch(
        self, job: ProgramContext, command: Command, how: Measuring
    ) -> Generator[Reading, None, Contact | None]:
        """Lower the head once until the probe triggers; None: it is only planned."""
        found: list[Contact] = []
        if self._each:
            yield from self._run_lines(job, command, self._activate)
        call = job.call(command)

        async def go_down() -> Done:
            assert self._live is not None
            move = ProbingMove(
                self._live.machine,
                call.position,
                lowest_z=self._lowest_z,
                speed=how.speed,
                corrected=self._skews is not None and self._skews.now != Skew(),
                accel=self.probing_accel,
                say=self._live.say,
            )
            try:
                async with self.touching(alone=False):
                    contact = await move.run()
                    contact = await self._measured(contact)
            except NotReadyError as error:
                raise CanductorError(f"{command.name} failed: {error}; {await self._place()}") from error
            except CanductorError as error:
                if self._live.machine.stopped is not None:
                    raise
                raise CanductorError(f"{command.name} failed: {error}") from error
            found.append(contact)
            return Done(position=found[0].position, moved=True)

        yield AtStandstill(go_down)
        if not found:
            return None
        if self._each:
            yield from self._run_lines(job, command, self._deactivate)
        return found[0]

    async def _measured(self, contact: Contact) -> Contact:
        """Return CONTACT, for a probe that measures at standstill with the height that it found."""
        height_mm = await self.standing_mm()
        if height_mm is None:
            return contact
        return replace(contact, trigger_z=contact.position[2] - height_mm + self.offset[2])

    async def _place(self) -> str:
        place = await place_by_steps(self.live.machine)
        return "Z is not known" if place is None else f"Z is {place[2]:.3f} mm"

    def _correction(self, contact: Contact) -> float:
        x, y, _ = contact.trigger
        return sum(correction(x + self.offset[0], y + self.offset[1]) for correction in self.corrections)

    def _found(self, contact: Contact, height: float) -> Measured:
        x, y, _ = contact.trigger
        dx, dy, dz = self.offset
        return Measured((x, y, height), (x + dx, y + dy, height - dz))

    def _run_lines(
        self, job: ProgramContext, command: Command, template: GCodeTemplate | None
    ) -> Iterator[Reading]:
        """Run lines that must leave the head where it is."""
        if template is None or not template.text.strip():
            return
        before = job.planner.toolhead_position[:3]
        yield template.lines(job.call(command), {})
        after = job.planner.toolhead_position[:3]
        if any(abs(here - there) > SAME_MM for here, there in zip(after, before, strict=True)):
            raise WordError(
                f"{command.name}: the lines that activate or deactivate [{self.name}] moved the head; let"
                " them bring it back"
            )


def lift(job: ProgramContext, z: float, speed: float) -> Iterator[Reading]:
    """Move to Z at SPEED, X and Y as they are."""
    x, y, _, e = job.planner.toolhead_position
    yield ProgramAction(lambda job: go(job, [x, y, z, e], speed))

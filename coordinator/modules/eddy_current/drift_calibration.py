"""TEMPERATURE_PROBE_CALIBRATE: how the frequency of an eddy current probe's coil drifts while it gets warm.

The coil measures at some heights, again and again at higher temperatures; each time the bed is found by hand
first. TEMPERATURE_PROBE_NEXT begins that search, by itself when the coil is warm enough for the next sample.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

from coordinator.config.options import BadValue, FloatOption, Option, SectionSpec
from coordinator.config.sections.bounds import MAX_POSITION, MAX_SPEED
from coordinator.gcode.builtins.state import go
from coordinator.gcode.commands import (
    AtStandstill,
    Call,
    Immediate,
    Lines,
    Phases,
    ProgramAction,
    ProgramContext,
    Reading,
)
from coordinator.gcode.events import Done
from coordinator.gcode.parameters import bounded, flag
from coordinator.gcode.parser import Command, WordError, quoted
from coordinator.kinematics.base import Point
from coordinator.modules.base import Build, Module
from coordinator.modules.eddy_current.coil_drift import HEIGHTS, LEAST, CoilDrift, Sample, drift_of
from coordinator.modules.eddy_current.eddy_probe import EddyProbe
from coordinator.modules.heaters.heaters import HeaterRegistry
from coordinator.modules.probes.manual_probe import ManualProbe
from coordinator.modules.probes.probe import lift

HOTTEST_C: Final = 200.0
APART_C: Final = 1.0
"""Samples have to be further apart than that."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PointOption(Option[Point]):
    """X, Y and Z of a place."""

    def parse(self, text: str) -> Point:
        """Return it."""
        number = FloatOption(name="", help="", minimum=-MAX_POSITION, maximum=MAX_POSITION)
        words = [number.parse(word.strip()) for word in text.split(",")]
        if len(words) != 3:
            raise BadValue
        x, y, z = words
        return (x, y, z)

    def rule(self) -> str:
        """Return what is allowed."""
        return "X, Y and Z in mm, with commas between them"

    def stand_in(self) -> Point:
        """Return any place."""
        return (0.0, 0.0, 0.0)


SPEED: Final = FloatOption(
    name="speed",
    help="of the way to calibration_position",
    default=50.0,
    unit="mm/s",
    above=0,
    maximum=MAX_SPEED,
)
HEIGHT: Final = FloatOption(
    name="horizontal_move_z",
    help="height of that way",
    default=2.0,
    unit="mm",
    minimum=0,
    maximum=MAX_POSITION,
)
RESTING_Z: Final = FloatOption(
    name="resting_z",
    help="height of the nozzle above the bed while the coil gets warm",
    default=0.4,
    unit="mm",
    minimum=0,
    maximum=MAX_POSITION,
)
POSITION: Final = PointOption(
    name="calibration_position", help="where a calibration begins; by default where the head is"
)


def _celsius(name: str, of_what: str, **more: Any) -> FloatOption:
    return FloatOption(name=name, help=of_what, unit="°C", minimum=0, maximum=500, **more)


BED_TEMP: Final = _celsius(
    "calibration_bed_temp", "of the bed during a calibration; by default it is not heated"
)
EXTRUDER_TEMP: Final = _celsius(
    "calibration_extruder_temp", "of the extruder during a calibration; by default it is not heated"
)
HEATING_Z: Final = FloatOption(
    name="extruder_heating_z",
    help="height at which the extruder is heated before a calibration",
    default=50.0,
    unit="mm",
    minimum=0,
    maximum=MAX_POSITION,
)
VALID_TEMP: Final = _celsius(
    "max_validation_temp", "up to which a calibration has to be plausible, to be kept", default=60.0
)
PROCEDURE_OPTIONS: Final[tuple[Option[Any], ...]] = (
    *(SPEED, HEIGHT, RESTING_Z, POSITION),
    *(BED_TEMP, EXTRUDER_TEMP, HEATING_Z, VALID_TEMP),
)


@dataclass(frozen=True, slots=True)
class Procedure:
    """How a coil is to be calibrated; mm, mm/s, °C."""

    speed: float
    height: float
    resting_z: float
    position: Point | None
    bed_c: float | None
    extruder_c: float | None
    heating_z: float
    valid_c: float


def procedure_of(build: Build) -> Procedure:
    """Return what PROCEDURE_OPTIONS say; raises ConfigError."""
    return Procedure(
        speed=build.get(SPEED),
        height=build.get(HEIGHT),
        resting_z=build.get(RESTING_Z),
        position=build.find(POSITION),
        bed_c=build.find(BED_TEMP),
        extruder_c=build.find(EXTRUDER_TEMP),
        heating_z=build.get(HEATING_Z),
        valid_c=build.get(VALID_TEMP),
    )


class Coil(Protocol):
    """A coil whose drift is to be found."""

    name: str
    """Of the section that measures its temperature."""
    instance: str
    procedure: Procedure

    @property
    def probe(self) -> EddyProbe:
        """The probe that it belongs to."""

    @property
    def celsius(self) -> float | None:
        """How warm it is; None: that is not measured."""

    def keep(self, drift: CoilDrift, lowest_c: float) -> bool:
        """Correct by DRIFT from now on; return whether it is known at which temperature heights are right."""

    def enable(self, *, enabled: bool) -> None:
        """Correct, or do not; raises CanductorError where no drift is known."""


@dataclass(slots=True)
class _Calibration:
    """One that is going on."""

    coil: Coil
    command: Command
    target_c: float
    step_c: float
    samples: list[Sample] = field(default_factory=list)
    next_c: float = 0.0
    asked: bool = True
    """Whether TEMPERATURE_PROBE_NEXT was given for the next sample."""

    @property
    def procedure(self) -> Procedure:
        """How it is done."""
        return self.coil.procedure

    @property
    def coldest_c(self) -> float:
        """The lowest temperature of all samples."""
        return min(celsius for sample in self.samples for celsius, _ in sample)

    @property
    def warmest_c(self) -> float:
        """The highest one."""
        return max(celsius for sample in self.samples for celsius, _ in sample)

    def heated(self) -> Iterator[str]:
        """Yield the heaters that it switches on."""
        if self.procedure.bed_c:
            yield "heater_bed"
        if self.procedure.extruder_c:
            yield "extruder"


class DriftCalibration(Module):
    """The commands."""

    SPEC = SectionSpec("Commands of temperature probes", ())

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.coil: Coil | None = None
        """That of the machine's probe; None: it has none whose temperature is measured."""
        self._calibration: _Calibration | None = None
        self._heaters = build.shared(HeaterRegistry)
        self._manual = build.shared(ManualProbe)
        self._manual.others.append(self)
        for name, text, read in (
            (
                "TEMPERATURE_PROBE_CALIBRATE",
                "Find how the coil of PROBE= drifts up to TARGET= °C, in steps of STEP=",
                self._read_begin,
            ),
            ("TEMPERATURE_PROBE_NEXT", "Begin to take the next sample of that calibration", self._read_next),
            ("TEMPERATURE_PROBE_COMPLETE", "End that calibration with what it has", self._read_complete),
            (
                "TEMPERATURE_PROBE_ENABLE",
                "ENABLE=1: correct the drift of the coil; 0: do not",
                self._read_enable,
            ),
        ):
            build.add_command(name, text, read)

    def end(self, cause: str) -> None:
        """End a calibration without a result; all heaters are off."""
        del cause
        self._calibration = None

    def _coil(self, call: Call, probe: str | None = None) -> Coil:
        """Return the coil, which has to be that of PROBE; raises WordError."""
        coil = self.coil
        if coil is None:
            raise WordError(
                f"{call.command.name} is for a [temperature_probe NAME] with the NAME of a"
                " [probe_eddy_current], and there is none"
            )
        if probe not in (None, coil.instance, coil.name):
            raise WordError(f"PROBE of {call.command.name} is {quoted(probe)}; the probe is {coil.instance}")
        return coil

    def _read_enable(self, call: Call) -> Reading:
        given = call.parameters("ENABLE")
        coil = self._coil(call)
        if "ENABLE" not in given:
            raise WordError("TEMPERATURE_PROBE_ENABLE needs ENABLE=0 or ENABLE=1")
        enabled = flag(call.command, given, "ENABLE")

        async def act() -> Done:
            coil.enable(enabled=enabled)
            return Done((f"{coil.name}: the drift of the coil is {'' if enabled else 'not '}corrected",))

        return AtStandstill(act)

    # -------------------------------------------------------------------------------------------- dialogue

    @property
    def is_going_on(self) -> bool:
        """Whether there is a calibration."""
        return self._calibration is not None

    @property
    def is_active(self) -> bool:
        """Whether one waits, between two searches, for an answer."""
        return self.is_going_on and not self._manual.is_searching

    def read_accept(self, call: Call) -> Reading:
        """Refuse it: a search begins with TEMPERATURE_PROBE_NEXT."""
        raise WordError(f"{call.command.name}: nothing is looked for; TEMPERATURE_PROBE_NEXT begins that")

    def read_abort(self, call: Call) -> Reading:
        """End it without a result."""
        del call
        return Phases(lambda _: self._end("the calibration was aborted; nothing is kept"))

    def measured(self, celsius: float) -> None:
        """Take the temperature of the coil; on the control loop."""
        going_on = self._calibration
        if going_on is not None and not going_on.asked and celsius >= going_on.next_c:
            going_on.asked = True
            self.live.say(f"{going_on.coil.name}: the coil has {celsius:.1f} °C: TEMPERATURE_PROBE_NEXT")
            if (runner := self.live.machine.runner) is not None:
                runner.run_lines(going_on.coil.name, ["TEMPERATURE_PROBE_NEXT"])

    def _read_begin(self, call: Call) -> Reading:
        given = call.parameters("PROBE", "TARGET", "STEP")
        coil = self._coil(call, given.get("PROBE"))
        step_c = bounded(call.command, given, "STEP", 2.0, low=APART_C, high=50)
        target_c = bounded(call.command, given, "TARGET", coil.procedure.valid_c, low=1, high=HOTTEST_C)
        self._manual.check_free(call)

        async def begin() -> Done:
            self._calibration = _Calibration(coil, call.command, target_c, step_c)
            return Done()

        def run(job: ProgramContext) -> Iterator[Reading]:
            with self._ending_early():
                yield AtStandstill(begin)
                if self._calibration is not None:
                    yield from self._prepare(job, coil.procedure)
                    yield self._search(job.call(call.command))

        return Phases(run)

    def _prepare(self, job: ProgramContext, to: Procedure) -> Iterator[Reading]:
        """Heat what is to be heated, and go where the calibration is to begin."""
        if to.bed_c:
            yield self._heat("heater_bed", to.bed_c)
        if to.extruder_c:
            yield from lift(job, max(to.heating_z, job.planner.toolhead_position[2]), to.speed)
            yield self._heat("extruder", to.extruder_c)
            yield Lines(f"TEMPERATURE_WAIT SENSOR=extruder MINIMUM={to.extruder_c - 2:g}")
        if to.position is not None:
            yield from lift(job, max(to.height, job.planner.toolhead_position[2]), to.speed)
            yield from self._approach(job, to.position, to.speed)

    def _heat(self, name: str, celsius: float) -> AtStandstill:
        """Return what sets a target at once: one that waits for its time might outlast the calibration."""
        unit = self._heaters.units.get(name)
        if unit is None:
            raise WordError(f"the calibration needs {name}, which does not act")
        unit.check_target(celsius)

        async def perform() -> None:
            unit.set_target(celsius)

        return AtStandstill(perform)

    def _approach(self, job: ProgramContext, place: Point, speed: float) -> Iterator[Reading]:
        """Go to a PLACE, with its height at the end."""
        x, y, z = place
        there = [x, y, *job.planner.toolhead_position[2:]]
        yield ProgramAction(lambda job: go(job, there, speed))
        yield from lift(job, z, speed)

    def _search(self, call: Call) -> Reading:
        return self._manual.follow(call, self._sample, asked_by=self)

    def _read_next(self, call: Call) -> Reading:
        call.parameters()
        going_on = self._going_on(call)
        celsius = going_on.coil.celsius
        if going_on.samples and celsius is not None and celsius < going_on.warmest_c + APART_C:
            raise WordError(
                f"TEMPERATURE_PROBE_NEXT: the coil has {celsius:.1f} °C, and the last sample is of"
                f" {going_on.warmest_c:.1f} °C; wait until it is warmer"
            )
        going_on.asked = True
        return self._search(call)

    def _going_on(self, call: Call) -> _Calibration:
        if self._calibration is None:
            raise WordError(
                f"{call.command.name} is for a calibration; begin with TEMPERATURE_PROBE_CALIBRATE"
            )
        return self._calibration

    def _sample(self, job: ProgramContext, touched: Point) -> Iterator[Reading]:
        """Measure above the place where the nozzle TOUCHED the bed."""
        if (going_on := self._calibration) is not None:
            with self._ending_early():
                yield from self._measure(job, touched, going_on)

    def _measure(self, job: ProgramContext, touched: Point, going_on: _Calibration) -> Iterator[Reading]:
        coil, measured = going_on.coil, list[float | None]()
        points = yield from coil.probe.measure_above(
            job, going_on.command, touched, HEIGHTS, lambda: measured.append(coil.celsius)
        )
        if not points:
            return
        temperatures = [celsius for celsius in measured if celsius is not None]
        if len(temperatures) < len(points):
            raise WordError(
                f"{going_on.command.name}: [{coil.name}] measures no temperature; check its sensor"
            )
        frequencies = [frequency for _, frequency in points]
        going_on.samples.append(list(zip(temperatures, frequencies, strict=True))[::-1])
        x, y, z = touched
        yield from self._approach(job, (x, y, z + going_on.procedure.resting_z), going_on.procedure.speed)
        after_c = temperatures[-1]
        if after_c >= going_on.target_c and len(going_on.samples) >= LEAST:
            yield from self._complete(going_on)
            return
        going_on.next_c, going_on.asked = after_c + going_on.step_c, False
        text = (
            f"sample {len(going_on.samples)} at {after_c:.1f} °C; the next begins at {going_on.next_c:.1f} °C"
            " or with TEMPERATURE_PROBE_NEXT; TEMPERATURE_PROBE_COMPLETE or ABORT end the calibration"
        )
        yield Immediate((text,))

    def _read_complete(self, call: Call) -> Reading:
        call.parameters()
        going_on = self._going_on(call)
        if self._manual.is_searching:
            raise WordError(f"{call.command.name}: a height is looked for; ACCEPT it first, or ABORT")
        if len(going_on.samples) < LEAST:
            raise WordError(
                f"{call.command.name}: {len(going_on.samples)} of {LEAST} samples are there; go on with"
                " TEMPERATURE_PROBE_NEXT, or ABORT"
            )

        def run(_: ProgramContext) -> Iterator[Reading]:
            with self._ending_early():
                yield from self._complete(going_on)

        return Phases(run)

    def _complete(self, going_on: _Calibration) -> Iterator[Reading]:
        coil, drift, lowest_c = going_on.coil, drift_of(going_on.samples), going_on.coldest_c
        if not drift.is_plausible(lowest_c, max(going_on.procedure.valid_c, going_on.warmest_c)):
            yield from self._end("the calibration is not kept: it is not plausible up to max_validation_temp")
            return
        text = (
            f"{coil.name}: {len(going_on.samples)} samples from {lowest_c:.1f} to"
            f" {going_on.warmest_c:.1f} °C; SAVE_CONFIG writes them"
        )

        async def keep() -> Done:
            heights_known = coil.keep(drift, lowest_c)
            more = "" if heights_known else "; now calibrate with PROBE_EDDY_CURRENT_CALIBRATE"
            return Done((text + more,))

        yield AtStandstill(keep)
        yield from self._end("the calibration has ended")

    def _end(self, text: str) -> Iterator[Reading]:
        """End the calibration, with its heaters switched off."""
        self._switch_off()
        yield Immediate((text,))

    @contextmanager
    def _ending_early(self) -> Iterator[None]:
        """End the calibration where the block does not come to its end: it fails, or is cancelled."""
        try:
            yield
        except BaseException:
            self._switch_off("the calibration ended early; nothing is kept")
            raise

    def _switch_off(self, why: str = "") -> None:
        """Forget the calibration and switch its heaters off, from the reader's thread; WHY is shown."""
        going_on, self._calibration = self._calibration, None
        if going_on is None or (live := self._live) is None:
            return

        def act() -> None:
            for name in self._heaters.units.keys() & set(going_on.heated()):
                self._heaters.units[name].set_target(0.0)
            if why:
                live.say(f"{going_on.coil.name}: {why}")

        live.soon_on_loop(act)

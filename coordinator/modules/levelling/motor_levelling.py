"""What [z_tilt] and [quad_gantry_level] have in common: each motor of Z is moved by itself until it is level.

A pass measures the places, moves the motors, and looks how far apart the heights were; passes repeat until
that is within the tolerance.
"""

import math
from abc import abstractmethod
from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from coordinator.config.errors import ConfigError
from coordinator.config.options import BoolOption, FloatOption, IntOption, Option
from coordinator.gcode.commands import (
    AtStandstill,
    Call,
    Immediate,
    Phases,
    ProgramContext,
    Reading,
)
from coordinator.gcode.events import Done
from coordinator.gcode.parameters import bounded
from coordinator.gcode.parser import Command, WordError
from coordinator.kinematics.base import Point
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.drivers.motor_power import MotorPower
from coordinator.modules.levelling.points import OPTIONS as POINT_OPTIONS
from coordinator.modules.levelling.points import ProbePoints, how_to_measure
from coordinator.modules.levelling.surfaces import Place, adjustments, spread_mm
from coordinator.modules.probes.probe import Measured, Measuring, Probe
from coordinator.runtime.module_context import ModuleContext
from coordinator.runtime.moves.single import Ramp, SingleMove
from coordinator.support.values import Value

RETRIES: Final = IntOption(
    name="retries", help="how many further passes there may be until all is level", default=0, minimum=0
)
RETRY_TOLERANCE: Final = FloatOption(
    name="retry_tolerance",
    help="how far apart the heights may be at the end",
    default=0.0,
    unit="mm",
    minimum=0,
    maximum=100,
)
INCREASING: Final = FloatOption(
    name="increasing_threshold",
    help="how much the spread of heights may grow from one pass to the next",
    default=1e-7,
    unit="mm",
    minimum=0,
    maximum=100,
)
ADAPTIVE: Final = BoolOption(
    name="adaptive_horizontal_move_z",
    help="whether the head travels lower after the first pass: as high as the heights were apart, rounded up",
    default=False,
)
LEAST_HEIGHT: Final = FloatOption(
    name="min_horizontal_move_z",
    help="lowest height of these ways; the probe must not touch the bed there",
    default=1.0,
    unit="mm",
    minimum=0,
    maximum=1000,
)
OPTIONS: Final[tuple[Option[Any], ...]] = (
    *POINT_OPTIONS,
    RETRIES,
    RETRY_TOLERANCE,
    INCREASING,
    ADAPTIVE,
    LEAST_HEIGHT,
)
UNSUPPORTED: Final = (
    *("enforce_lift_speed", "use_adjustments", "alternate_probe_direction", "start_reverse"),
)
SMALL_MM: Final = 1e-4
"""Less than a step: nothing to move."""


@dataclass(frozen=True, slots=True)
class _Pass:
    """One of the passes of a command."""

    command: Command
    retries: int
    tolerance: float
    """How far apart the heights may be at the end, mm."""
    number: int = 1
    before: float = math.inf
    """How far apart they were in the pass before, mm."""
    height: float | None = None
    """Of the ways between places, mm; None: as the command or the section says."""


class MotorLevelling(Module):
    """A section that levels by the motors of Z; COMMAND does it."""

    COMMAND: str
    HELP: str

    def __init__(self, build: Build, places: Sequence[Place]) -> None:
        super().__init__(build)
        self._machine = build.machine
        rail = next((rail for rail in build.machine.rails if rail.axis == "z"), None)
        self.motors = () if rail is None else rail.steppers
        """Those of Z, in order."""
        if any(motor.weights != (0.0, 0.0, 1.0, 0.0) for motor in self.motors) or len(self.motors) < 2:
            raise ConfigError(
                build.place,
                f"[{build.name}] needs two or more motors that move Z alone ([stepper_z1], …); add them, or"
                " remove it",
            )
        self.points = ProbePoints(build, places)
        self._retries, self._tolerance = build.get(RETRIES), build.get(RETRY_TOLERANCE)
        self._increasing = build.get(INCREASING)
        adaptive, least = build.get(ADAPTIVE), build.get(LEAST_HEIGHT)
        self._least_height = least if adaptive else None
        self.probe: Probe | None = None
        self._live: ModuleContext | None = None
        self.applied = False
        build.shared(MotorPower).when_off.append(self._off)
        build.add_command(self.COMMAND, self.HELP, self._read)

    def link(self, modules: Modules) -> None:
        """Find the probe; raises NotSupported for one that does not act yet."""
        self.probe = self.points.find_probe(modules)

    async def connect(self, live: ModuleContext) -> None:
        """Take over the machine."""
        self._live = live

    def status(self) -> Mapping[str, Value]:
        """Report whether it was done since the motors were switched on."""
        return {"applied": self.applied}

    def corrected(self, measured: Sequence[Point]) -> list[Point]:
        """Return MEASURED points of the bed as they count."""
        return list(measured)

    @abstractmethod
    def heights(self, measured: Sequence[Point]) -> list[float]:
        """Return how high the bed seems to be at each motor, by what was MEASURED."""

    def check(self, adjusts_mm: Sequence[float]) -> str:
        """Say why the motors must not move by ADJUSTS_MM; empty: they may."""
        del adjusts_mm
        return ""

    def _off(self, motors: Collection[str]) -> None:
        if any(motor.name in motors for motor in self.motors):
            self.applied = False

    # ---------------------------------------------------------------------------------------------- passes

    def _read(self, call: Call) -> Reading:
        how = how_to_measure(call, self.probe)
        by = None if how is None or self.probe is None else (self.probe, how)
        given = call.parameters("RETRIES", "RETRY_TOLERANCE")
        retries = round(bounded(call.command, given, "RETRIES", self._retries, low=0, high=1000))
        tolerance = bounded(call.command, given, "RETRY_TOLERANCE", self._tolerance, low=0, high=100)
        self.check_call(call, None if by is None else by[0])
        first = _Pass(call.command, retries, tolerance)

        def run(job: ProgramContext) -> Iterator[Reading]:
            self.applied = False
            yield from self._by_hand(job, first) if by is None else self._by_probe(job, first, *by)

        return Phases(run)

    def check_call(self, call: Call, probe: Probe | None) -> None:
        """Raise WordError where nothing can be measured, by PROBE or else by hand."""
        self.points.check(call, probe)
        if missing := next((letter for letter in "XY" if letter not in call.homed), ""):
            raise WordError(f"{call.command.name} comes before {missing} is homed; home with G28 first")

    def _by_probe(
        self, job: ProgramContext, first: "_Pass", probe: Probe, how: Measuring
    ) -> Iterator[Reading]:
        now: _Pass | None = first
        while now is not None:
            found = yield from self.points.measure(job, now.command, probe, how, height=now.height)
            if found is None:
                return
            now = yield from self._level(job, now, found, how.lift_speed)

    def _by_hand(self, job: ProgramContext, now: "_Pass") -> Iterator[Reading]:
        def measured(job: ProgramContext, found: list[Measured]) -> Iterator[Reading]:
            further = yield from self._level(job, now, found, self.points.speed)
            if further is not None:
                yield from self._by_hand(job, further)

        yield from self.points.collect(job, job.call(now.command), None, measured)

    def _level(
        self, job: ProgramContext, now: "_Pass", found: Sequence[Measured], speed: float
    ) -> Generator[Reading, None, "_Pass | None"]:
        """Move the motors by what was FOUND, at SPEED; return the pass that follows, None: all is level."""
        measured = self.corrected([one.bed for one in found])
        spread = spread_mm(measured)
        adjusts, mean = adjustments(self.heights(measured))
        yield Immediate((self._report(now.number, spread, adjusts),))
        if why := self.check(adjusts):
            raise WordError(f"{now.command.name} failed: {why}")
        call = job.call(now.command)
        yield AtStandstill(lambda: self.adjust(call, adjusts, mean, speed))
        if spread <= now.tolerance or now.retries == 0:
            self.applied = True
            return None
        if spread > now.before + self._increasing:
            raise WordError(
                f"{now.command.name} failed: the heights are {spread:.4f} mm apart, more than"
                f" {now.before:.4f} in the pass before: check that the motors are in the order of their"
                " places"
            )
        if now.number > now.retries:
            raise WordError(
                f"{now.command.name} failed: the heights are {spread:.4f} mm apart after {now.number} passes,"
                f" more than retry_tolerance ({now.tolerance:g} mm)"
            )
        height = None
        if self._least_height is not None:
            height = max(float(math.ceil(spread)), self._least_height)
        return replace(now, number=now.number + 1, before=spread, height=height)

    def _report(self, number: int, spread: float, adjusts: Sequence[float]) -> str:
        moves = ", ".join(f"{motor.name} {by:+.4f}" for motor, by in zip(self.motors, adjusts, strict=True))
        return f"pass {number}: the heights are {spread:.4f} mm apart; moves in mm: {moves}"

    async def adjust(self, call: Call, adjusts: Sequence[float], mean: float, speed: float) -> Done:
        """Move the motors; return where the head is then.

        By a probe that is the endstop of Z the bed is at 0 then; else Z stays what it is.
        """
        assert self._live is not None
        limits, probe = self._machine.limits, self._machine.probe
        most = max(abs(by) for by in adjusts)
        if most > SMALL_MM:
            ways = {motor.name: by / most for motor, by in zip(self.motors, adjusts, strict=True)}
            ramp = Ramp(most, min(speed, limits.max_z_velocity), min(limits.max_accel, limits.max_z_accel))
            await SingleMove(self._live.machine, ramp, ways=ways).run()
        by_probe = probe is not None and probe.rail.axis == "z"
        x, y, z, e = call.position
        return Done(position=(x, y, z - mean if by_probe else z, e), moved=True)

"""What [z_tilt] and [quad_gantry_level] have in common: each motor of Z is moved by itself until it is level.

A pass measures the places, moves the motors, and looks how far apart the heights were; passes repeat until
that is within the tolerance.
"""

import math
from abc import abstractmethod
from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from typing import Any, Final

from coordinator.config.errors import ConfigError, NotSupported
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
from coordinator.modules.levelling.points import ProbePoints
from coordinator.modules.levelling.surfaces import Place, adjustments, spread_mm
from coordinator.modules.probes.probe import Measuring, Probe
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


class MotorLevelling(Module):
    """A section that levels by the motors of Z; COMMAND does it."""

    COMMAND: str
    HELP: str

    def __init__(self, build: Build, places: Sequence[Place]) -> None:
        super().__init__(build)
        self._machine, self._place = build.machine, build.place
        rail = next((rail for rail in build.machine.rails if rail.axis == "z"), None)
        self.motors = () if rail is None else rail.steppers
        """Those of Z, in order."""
        if any(motor.weights != (0.0, 0.0, 1.0, 0.0) for motor in self.motors) or len(self.motors) < 2:
            raise ConfigError(
                build.place,
                f"[{build.name}] needs two or more motors that move Z alone ([stepper_z1], …); add them, or"
                " remove it",
            )
        self._points = ProbePoints(build, places)
        self._retries, self._tolerance = build.get(RETRIES), build.get(RETRY_TOLERANCE)
        self._increasing = build.get(INCREASING)
        adaptive, least = build.get(ADAPTIVE), build.get(LEAST_HEIGHT)
        self._least_height = least if adaptive else None
        self._probe: Probe | None = None
        self._live: ModuleContext | None = None
        self.applied = False
        build.shared(MotorPower).when_off.append(self._off)
        build.add_command(self.COMMAND, self.HELP, self._read)

    def link(self, modules: Modules) -> None:
        """Find the probe; raises ConfigError."""
        self._probe = next((modules.find(name, Probe) for name in modules.names(Probe)), None)
        if self._probe is None:
            raise NotSupported(self._place, "it needs a probe that acts: [probe]")

    async def connect(self, live: ModuleContext) -> None:
        """Take over the machine."""
        self._live = live

    def status(self) -> Mapping[str, Value]:
        """Report whether it was done since the motors were switched on."""
        return {"applied": self.applied}

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
        assert self._probe is not None
        how = self._probe.how(call.command)
        self._points.height(call.command)
        given = call.parameters("RETRIES", "RETRY_TOLERANCE")
        retries = round(bounded(call.command, given, "RETRIES", self._retries, low=0, high=1000))
        tolerance = bounded(call.command, given, "RETRY_TOLERANCE", self._tolerance, low=0, high=100)
        self._probe.check(call)
        if missing := next((letter for letter in "XY" if letter not in call.homed), ""):
            raise WordError(f"{call.command.name} comes before {missing} is homed; home with G28 first")
        return Phases(lambda job: self._run(job, call.command, how, (retries, tolerance)))

    def _run(
        self, job: ProgramContext, command: Command, how: Measuring, until: tuple[int, float]
    ) -> Iterator[Reading]:
        assert self._probe is not None
        retries, tolerance = until
        before = float("inf")
        height = None
        self.applied = False
        for number in range(1, retries + 2):
            found = yield from self._points.measure(job, command, self._probe, how, height=height)
            if found is None:
                return
            spread = yield from self._level(
                job, command, [one.bed for one in found], (number, how.lift_speed)
            )
            if spread <= tolerance or retries == 0:
                self.applied = True
                return
            if spread > before + self._increasing:
                raise WordError(
                    f"{command.name} failed: the heights are {spread:.4f} mm apart, more than {before:.4f} in"
                    " the pass before: check that the motors are in the order of their places"
                )
            before = spread
            if self._least_height is not None:
                height = max(float(math.ceil(spread)), self._least_height)
        raise WordError(
            f"{command.name} failed: the heights are {before:.4f} mm apart after {retries + 1} passes, more"
            f" than retry_tolerance ({tolerance:g} mm)"
        )

    def _level(
        self, job: ProgramContext, command: Command, measured: Sequence[Point], how: tuple[int, float]
    ) -> Generator[Reading, None, float]:
        """Move the motors by what was MEASURED; return how far apart the heights were.

        HOW: the number of the pass, and the speed of the motors, mm/s.
        """
        number, speed = how
        spread = spread_mm(measured)
        adjusts, mean = adjustments(self.heights(measured))
        yield Immediate((self._report(number, spread, adjusts),))
        if why := self.check(adjusts):
            raise WordError(f"{command.name} failed: {why}")
        call = job.call(command)
        yield AtStandstill(lambda: self._adjust(call, adjusts, mean, speed))
        return spread

    def _report(self, number: int, spread: float, adjusts: Sequence[float]) -> str:
        moves = ", ".join(f"{motor.name} {by:+.4f}" for motor, by in zip(self.motors, adjusts, strict=True))
        return f"pass {number}: the heights are {spread:.4f} mm apart; moves in mm: {moves}"

    async def _adjust(self, call: Call, adjusts: Sequence[float], mean: float, speed: float) -> Done:
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

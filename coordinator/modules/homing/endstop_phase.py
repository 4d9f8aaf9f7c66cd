"""[endstop_phase STEPPER]: an endstop that is exact to a step, by the phase of its motor's driver.

A switch closes at about the same place, and within an electrical cycle of the motor (four full steps) the
phase of the driver identifies the step exactly. Its deviation from the phase that is
expected is taken off: homing then repeats to the step, as long as the switch is good for half a cycle.

A driver on a UART reports its phase (MSCNT); of any other one the steps that the node has counted since its
reset are taken for it, which is right for as long as the driver keeps its supply.
"""

import math
from collections import Counter
from collections.abc import Mapping
from typing import ClassVar, Final

from coordinator.config.errors import ConfigError
from coordinator.config.model import StepperDescription
from coordinator.config.options import BadValue, BoolOption, FloatOption, Option, SectionSpec
from coordinator.config.sections.probe import NAME as PROBE
from coordinator.gcode.commands import Call, Immediate, Reading
from coordinator.gcode.parser import WordError, quoted
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.drivers.tmc_driver import TmcDriver
from coordinator.modules.homing.homing import Homing
from coordinator.modules.homing.homing_plan import AXES
from coordinator.runtime.moves.homing import HomingError, HomingResult
from coordinator.support.quoting import nearest_or_all
from coordinator.support.values import Value
from nodes.support.numbers import read_int

FULL_STEPS: Final = 4
"""Of a cycle. Both coils have the same current there: with a driver's MSCNT in the middle of each quarter."""
MSCNT_CYCLE: Final = 1024
"""What the driver counts in a cycle (data sheets of TMC2208 and TMC2209, register MSCNT)."""


class PhaseOption(Option[tuple[int, int]]):
    """A phase and how many there are in a cycle, as in 7/64."""

    def parse(self, text: str) -> tuple[int, int]:
        """Return both."""
        phase, phases = (read_int(word.strip()) for word in text.partition("/")[::2])
        if phase is None or phases is None or not 0 <= phase < phases <= MSCNT_CYCLE:
            raise BadValue
        return phase, phases

    def rule(self) -> str:
        """Return what is allowed."""
        return "a phase and the number of phases, as in 7/64"

    def stand_in(self) -> tuple[int, int]:
        """Return any phase."""
        return (0, 64)


ACCURACY: Final = FloatOption(
    name="endstop_accuracy",
    help="how far apart places at which the switch closes may be; without it a cycle, four full steps",
    unit="mm",
    above=0,
    maximum=10,
)
TRIGGER_PHASE: Final = PhaseOption(
    name="trigger_phase",
    help="the phase at which the switch closes, of how many; without it that of the first homing",
)

ALIGN_ZERO: Final = BoolOption(
    name="endstop_align_zero",
    help="take position_endstop for up to half a full step more or less, so that 0 is at a full step",
    default=False,
)


class EndstopPhases(Module):
    """The command, and the phases that were found since the start."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.name = "endstop_phase"
        self._steppers = {motor.name: motor for motor in build.machine.motors}
        self.found: dict[str, Counter[int]] = {}
        """By stepper: how often each phase was found."""
        self.last: dict[str, Value] = {}
        build.add_command(
            "ENDSTOP_PHASE_CALIBRATE",
            "Report the phases at which endstops switched; with STEPPER keep that of one as trigger_phase",
            self._read,
        )

    def status(self) -> Mapping[str, Value]:
        """Report, by stepper, the phase of the last homing, of how many, and the node's count there."""
        return {"last_home": dict(self.last)}

    def note(self, stepper: StepperDescription, phase: int, count: int) -> None:
        """Take note that the endstop of STEPPER switched at PHASE, where its node counted COUNT."""
        self.found.setdefault(stepper.name, Counter())[phase] += 1
        self.last[stepper.name] = {"phase": phase, "phases": phases_of(stepper), "mcu_position": count}

    def _read(self, call: Call) -> Reading:
        given = call.parameters("STEPPER")
        if "STEPPER" not in given:
            reports = [self._report(name) for name in self.found]
            return Immediate(tuple(reports) or ("no axis was homed yet",))
        name = given["STEPPER"].lower()
        if name not in self.found:
            hint = nearest_or_all(name, self.found) if self.found else "; none was homed yet"
            raise WordError(f"{call.command.name}: no phase of {quoted(name)} is known{hint}")
        counter, phases = self.found[name], phases_of(self._steppers[name])
        phase = middle_phase(counter, phases)
        text = f"{phase}/{phases}"

        def keep() -> None:
            if (live := self._live) is not None:
                section = f"{self.name} {name}"
                live.soon_on_loop(lambda: live.save(section, TRIGGER_PHASE.name, text))

        said = f"{name}: {TRIGGER_PHASE.name} is {text}; SAVE_CONFIG writes it"
        return Immediate((self._report(name), said), keep)

    def _report(self, name: str) -> str:
        counter, stepper = self.found[name], self._steppers[name]
        phases = phases_of(stepper)
        middle = middle_phase(counter, phases)
        most = max(abs(wrapped(phase - middle, phases)) for phase in counter)
        return (
            f"{name}: {counter.total()} times homed, around phase {middle}/{phases}, at most"
            f" {most * stepper.step_distance:.4f} mm from it"
        )


class EndstopPhase(Module):
    """A section: with a name it corrects the endstop of that stepper, without one it brings the command."""

    NAMED: ClassVar = True
    NAMELESS: ClassVar = True
    SPEC: ClassVar = SectionSpec(
        "Makes an endstop exact to the step, by the phase of its motor's driver",
        (ACCURACY, TRIGGER_PHASE, ALIGN_ZERO),
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._phases = build.shared(EndstopPhases)
        self._accuracy_mm, self._wanted = build.find(ACCURACY), build.find(TRIGGER_PHASE)
        self._driver: TmcDriver | None = None
        self._seen: tuple[int, int] | None = None
        self._stepper: StepperDescription | None = None
        self._align_to_mm: float | None = None
        """Where the endstop is, of an axis whose 0 is to be at a full step."""
        if not build.reader.section.instance:
            return
        stops = [rail for rail in build.machine.stops if rail.steppers and rail.axis != PROBE]
        first = {rail.steppers[0].name: rail for rail in stops}
        if build.instance not in first:
            raise ConfigError(
                build.place,
                f"[{build.name}] names a stepper without an endstop on a pin"
                f"{nearest_or_all(build.instance, first)}",
            )
        rail = first[build.instance]
        self._stepper = rail.steppers[0]
        if build.get(ALIGN_ZERO):
            if rail.axis not in AXES:
                raise build.reader.bad(ALIGN_ZERO, "which is for X, Y and Z: no 0 is at the 0 of this rail")
            self._align_to_mm = rail.homing.position_endstop

    def link(self, modules: Modules) -> None:
        """Find the driver, and correct what homing finds."""
        if self._stepper is None:
            return
        name = self._stepper.name
        self._driver = next((driver for driver in modules.of(TmcDriver) if driver.stepper.name == name), None)
        for homing in modules.of(Homing):
            homing.trigger_phases[name] = self

    async def before(self) -> None:
        """Take note of the phase at standstill before a move towards the endstop."""
        self._seen = await self._look()

    async def beyond_mm(self, result: HomingResult) -> float:
        """Return by how much further beyond the trigger of RESULT the rail stands; raises HomingError."""
        stepper = self._stepper
        assert stepper is not None
        count, mscnt = await self._look()
        made = next(one for one in result.overshoots if one.stepper == stepper.name)
        forward = 1 if result.moved[stepper.name] > 0 else -1
        at_trigger = count - forward * made.steps
        phases = phases_of(stepper)
        sense = 1 if self._driver is None else self._sense(stepper, count, mscnt)
        phase = (mscnt * phases // MSCNT_CYCLE - sense * (count - at_trigger)) % phases
        self._phases.note(stepper, phase, at_trigger)
        if self._wanted is None:
            self._wanted = phase, phases
        wanted = self._wanted[0] * phases // self._wanted[1]
        off = wrapped(phase - wanted, phases)
        most = phases / 2 if self._accuracy_mm is None else self._accuracy_mm / 2 / stepper.step_distance
        if abs(off) > math.ceil(most):
            raise HomingError(
                f"the endstop of {stepper.name} switched at phase {phase}/{phases} of its driver, and"
                f" {wanted}/{phases} was expected: that is more than endstop_accuracy; check the switch, or"
                " ENDSTOP_PHASE_CALIBRATE again"
            )
        # The phase is that of a whole step. The time of the trigger also gives a fraction of a step, which
        # does not belong to that phase and is not as repeatable.
        fraction_mm = made.distance_mm - made.steps * stepper.step_distance
        return sense * (off + self._off_zero(wanted, sense)) * forward * stepper.step_distance - fraction_mm

    def _off_zero(self, wanted: int, sense: int) -> float:
        """Return by how many phases the 0 of the axis is beyond the nearest full step, if that counts."""
        stepper = self._stepper
        if stepper is None or self._align_to_mm is None:
            return 0.0
        at_zero = wanted - sense * self._align_to_mm / stepper.step_distance
        full_step = 0 if self._driver is None else stepper.microsteps // 2
        return math.remainder(at_zero - full_step, stepper.microsteps)

    def _sense(self, stepper: StepperDescription, count: int, mscnt: int) -> int:
        """Return whether the driver's phase grows with the node's count (1), or falls (-1)."""
        assert self._seen is not None
        counted, turned = count - self._seen[0], mscnt - self._seen[1]
        per_step = MSCNT_CYCLE // phases_of(stepper)
        for sense in (1, -1):
            if (turned - sense * counted * per_step) % MSCNT_CYCLE == 0:
                return sense
        raise HomingError(
            f"the driver of {stepper.name} did not make the steps that its node counted: it turned by"
            f" {turned % MSCNT_CYCLE} of {MSCNT_CYCLE} of a cycle; check its microsteps and its supply"
        )

    async def _look(self) -> tuple[int, int]:
        """Return the node's count, and what the driver has in MSCNT; raises CanductorError."""
        stepper = self._stepper
        assert stepper is not None
        count = (await self.live.machine.query_stepper_counts())[stepper.name]
        if self._driver is not None:
            return count, await self._driver.read("MSCNT")
        return count, count % phases_of(stepper) * (MSCNT_CYCLE // phases_of(stepper))


def phases_of(stepper: StepperDescription) -> int:
    """Return how many phases, microsteps, a cycle has."""
    return FULL_STEPS * stepper.microsteps


def wrapped(phases: int, cycle: int) -> int:
    """Return the shortest way that is as many PHASES on in a CYCLE.

    >>> wrapped(60, 64), wrapped(4, 64), wrapped(-33, 64)
    (-4, 4, 31)
    """
    return (phases + cycle // 2) % cycle - cycle // 2


def middle_phase(counter: Mapping[int, int], phases: int) -> int:
    """Return the phase that is nearest to all in COUNTER (times found, by phase), round the cycle.

    >>> middle_phase({62: 1, 63: 1, 1: 1}, 64)
    63
    """
    return min(
        counter, key=lambda one: sum(times * abs(wrapped(at - one, phases)) for at, times in counter.items())
    )

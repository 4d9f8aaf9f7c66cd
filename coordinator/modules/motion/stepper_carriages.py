"""SET_STEPPER_CARRIAGES: other factors of the carriages that a motor of a generic_cartesian machine moves."""

from collections.abc import Iterator, Mapping
from functools import partial

from coordinator.config.options import BadValue
from coordinator.config.sections.kinematics.generic_cartesian import CARRIAGES
from coordinator.gcode.builtins.machine import come_to_standstill
from coordinator.gcode.commands import AtStandstill, Call, Phases, ProgramAction, ProgramContext, Reading
from coordinator.gcode.events import Done, WeightsChange
from coordinator.gcode.parameters import flag, needed, one
from coordinator.gcode.parser import Command, WordError, quoted
from coordinator.kinematics.base import Weights
from coordinator.kinematics.generic_cartesian import GenericCartesian
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.compensation.skew_correction import Skew, Skews
from coordinator.modules.homing.homing import Homing

NAME = "SET_STEPPER_CARRIAGES"


class StepperCarriages(Module):
    """The command, and what each motor follows."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._described = build.machine
        kinematics = build.machine.kinematics
        self._carriages: Mapping[str, int] = (
            dict(kinematics.carriages) if isinstance(kinematics, GenericCartesian) else {}
        )
        """Their axes, by name."""
        self._moved = {
            motor.name: _names(build.machine.modules.config[f"stepper {motor.name}"]["carriages"])
            for motor in build.machine.motors
        }
        """Names of the carriages of each motor."""
        self._homing: Homing | None = None
        self._skews: Skews | None = None
        text = "Let STEPPER move its CARRIAGES by other factors, until the next start"
        build.add_command(NAME, text, self._read)

    def link(self, modules: Modules) -> None:
        """Find who has to know it."""
        self._homing = next(modules.of(Homing), None)
        self._skews = next(modules.of(Skews), None)

    def _read(self, call: Call) -> Reading:
        command = call.command
        given = call.parameters("STEPPER", "CARRIAGES", "DISABLE_CHECKS")
        stepper = one(command, given, "STEPPER", self._moved)
        weights = self._weights(stepper, needed(command, given, "CARRIAGES"))
        if self._described.dual_carriage is not None:
            raise WordError(f"{NAME} is not possible on a machine with a second carriage")
        if self._skews is not None and self._skews.now != Skew():
            raise WordError(f"{NAME} is not possible while skew is corrected; SET_SKEW CLEAR=1 first")
        after = self._described.with_weights({stepper: weights})
        kinematics = after.kinematics
        assert isinstance(kinematics, GenericCartesian)
        if not flag(command, given, "DISABLE_CHECKS") and not kinematics.independent:
            raise WordError(
                f"with this {NAME} the motors would not move x, y and z independently; give DISABLE_CHECKS=1"
                " to all but the last of several changes"
            )
        return Phases(partial(self._change, command=command, stepper=stepper, weights=weights))

    def _weights(self, stepper: str, text: str) -> Weights:
        try:
            terms = dict(CARRIAGES.parse(text))
        except BadValue:
            raise WordError(f"CARRIAGES of {NAME} is {quoted(text)}; give {CARRIAGES.rule()}") from None
        moved = self._moved[stepper]
        if terms.keys() != moved:
            raise WordError(
                f"CARRIAGES of {NAME} is {quoted(text)}; {stepper} moves {', '.join(sorted(moved))}, of which"
                " only factors and signs can change"
            )
        weights = [0.0, 0.0, 0.0, 0.0]
        for name, factor in terms.items():
            weights[self._carriages[name]] = factor
        return (weights[0], weights[1], weights[2], weights[3])

    def _change(
        self, job: ProgramContext, *, command: Command, stepper: str, weights: Weights
    ) -> Iterator[Reading]:
        """Let the motor follow WEIGHTS from a standstill on; the head stays, and has the same position."""

        def follow(job: ProgramContext) -> bool:
            if not come_to_standstill(job):
                return False
            self._described = self._described.with_weights({stepper: weights})
            if self._homing is not None:
                self._homing.follow(self._described)
            if self._skews is not None:
                self._skews.straight = {**self._skews.straight, stepper: weights}
            job.emit(WeightsChange(job.line, {stepper: weights}, job.planner.print_time_end_s))
            return True

        yield ProgramAction(follow)
        done = Done(position=job.call(command).position)

        async def note() -> Done:
            self.live.machine.describe(self._described)
            return done

        yield AtStandstill(note, done)


def _names(text: str) -> frozenset[str]:
    return frozenset(name for name, _ in CARRIAGES.parse(text))

"""STEPPER_BUZZ: moves one motor back and forth, to identify it and to check its wiring."""

import math
from typing import Final

from coordinator.config.model import StepperDescription
from coordinator.gcode.commands import AtStandstill, Call, Reading
from coordinator.gcode.events import Done
from coordinator.gcode.parameters import one
from coordinator.modules.base import Build, Module
from coordinator.runtime.moves.single import Ramp, SingleMove

TIMES: Final = 10
WAY_MM: Final = 1.0
WAY_RAD: Final = math.radians(1.0)
"""Of a motor that turns something."""
THERE_S: Final = 0.25
"""One way takes about so long."""


class StepperBuzz(Module):
    """The command."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._steppers = {stepper.name: stepper for stepper in build.machine.steppers}
        build.add_command(
            "STEPPER_BUZZ", "Move the motor STEPPER back and forth ten times, by 1 mm or 1 degree", self._read
        )

    def _read(self, call: Call) -> Reading:
        name = one(call.command, call.parameters("STEPPER"), "STEPPER", self._steppers)
        stepper = self._steppers[name]
        done = Done(position=call.position, moved=True)  # it ends where it began, to the step

        async def buzz() -> Done:
            await self._buzz(stepper)
            return done

        return AtStandstill(buzz, done)

    async def _buzz(self, stepper: "StepperDescription") -> None:
        way = WAY_RAD if stepper.function.turns else WAY_MM
        speed = 2 * way / THERE_S
        ramp = Ramp(way, speed, 4 * speed / THERE_S)
        for direction in (1.0, -1.0) * TIMES:
            await SingleMove(self.live.machine, ramp, ways={stepper.name: direction}).run()

"""[force_move]: moves one motor without homing, and sets the position of the head. For tests and macros.

No limit applies to these moves, so the section has to enable them. A motor of the head that was
moved alone leaves all axes unknown.
"""

import math
from typing import Final

from coordinator.config.options import BoolOption, SectionSpec
from coordinator.gcode.commands import AtStandstill, Call, Reading
from coordinator.gcode.events import Done
from coordinator.gcode.parameters import bounded, needed, one
from coordinator.gcode.parser import WordError, quoted
from coordinator.modules.base import Build, Module
from coordinator.runtime.moves.single import Ramp, SingleMove

ENABLE: Final = BoolOption(
    name="enable_force_move",
    help="enables FORCE_MOVE and SET_KINEMATIC_POSITION, which ignore the limits of the machine",
    default=False,
)
DISTANCE_MAX_MM: Final = 1000.0
SPEED_MAX: Final = 10_000.0
ACCEL_MIN: Final = 1e-3
ACCEL_MAX: Final = 1_000_000.0
_AXES: Final = "XYZ"


class ForceMove(Module):
    """The commands."""

    SPEC = SectionSpec("Commands that move past all limits", (ENABLE,))

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._machine = build.machine
        if not build.get(ENABLE):
            return
        build.add_command(
            "FORCE_MOVE",
            "Move the motor STEPPER by DISTANCE mm at VELOCITY mm/s, with ACCEL mm/s² if given",
            self._read_move,
        )
        build.add_command(
            "SET_KINEMATIC_POSITION",
            "Set the position of the head: X Y Z in mm; SET_HOMED and CLEAR_HOMED name axes",
            self._read_position,
        )

    # ----------------------------------------------------------------------------------------------- moving

    def _read_move(self, call: Call) -> Reading:
        values = call.parameters("STEPPER", "DISTANCE", "VELOCITY", "ACCEL")
        name = one(call.command, values, "STEPPER", (s.name for s in self._machine.steppers))
        for key in ("DISTANCE", "VELOCITY"):
            needed(call.command, values, key)
        distance = bounded(call.command, values, "DISTANCE", 0.0, low=-DISTANCE_MAX_MM, high=DISTANCE_MAX_MM)
        speed = bounded(call.command, values, "VELOCITY", 0.0, low=1e-3, high=SPEED_MAX)
        limits = self._machine.limits
        accel = bounded(call.command, values, "ACCEL", 0.0, low=0.0, high=ACCEL_MAX)
        if 0 < accel < ACCEL_MIN:
            raise WordError(f"ACCEL of FORCE_MOVE is {accel:g}; it must be at least {ACCEL_MIN:g} mm/s²")
        of_head = name in [motor.name for motor in self._machine.motors]
        done = Done(position=call.position, unhomed=_AXES if of_head else "", moved=True)

        async def move() -> Done:
            await self._move(name, distance, speed, accel or min(limits.max_accel, limits.max_z_accel))
            return done

        return AtStandstill(move, done)

    async def _move(self, name: str, distance_mm: float, speed: float, accel: float) -> None:
        if distance_mm:
            ramp = Ramp(abs(distance_mm), speed, accel)
            ways = {name: math.copysign(1.0, distance_mm)}
            await SingleMove(self.live.machine, ramp, ways=ways).run()

    # -------------------------------------------------------------------------------------------- positions

    @staticmethod
    def _read_position(call: Call) -> Reading:
        values = call.parameters(*_AXES, "SET_HOMED", "CLEAR_HOMED")
        limit = 100_000.0
        x, y, z = (
            bounded(call.command, values, axis, at, low=-limit, high=limit)
            for axis, at in zip(_AXES, call.position[:3], strict=True)
        )
        known = _letters(call, values, "SET_HOMED", _AXES)
        unknown = _letters(call, values, "CLEAR_HOMED", "")
        homed = "".join(axis for axis in known if axis not in unknown)
        done = Done(position=(x, y, z, call.position[3]), homed=homed, unhomed=unknown)

        async def take() -> Done:
            return done

        return AtStandstill(take, done)


def _letters(call: Call, values: dict[str, str], key: str, default: str) -> str:
    letters = values.get(key, default).upper().replace(",", "")
    if set(letters) - set(_AXES):
        raise WordError(f"{key} of {call.command.name} is {quoted(values[key])}; it must be letters of X Y Z")
    return letters

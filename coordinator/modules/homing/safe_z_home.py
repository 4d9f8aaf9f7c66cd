"""[safe_z_home]: Z is homed at a given X and Y, and the head is lifted before it moves there."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

from coordinator.config.errors import ConfigError
from coordinator.config.options import BadValue, BoolOption, FloatOption, Option, SectionSpec
from coordinator.config.sections.bounds import MAX_POSITION, speed_option
from coordinator.gcode.commands import AtStandstill, Call, Phases, Position, ProgramContext, Reading
from coordinator.gcode.events import Done
from coordinator.gcode.parser import WordError
from coordinator.modules.base import Build, Module
from coordinator.modules.homing.homing import Homing
from coordinator.runtime.moves.straight import move_by
from nodes.support.errors import CanductorError


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceOption(Option[tuple[float, float]]):
    """X and Y."""

    def parse(self, text: str) -> tuple[float, float]:
        """Return both."""
        number = FloatOption(name="", help="", minimum=-100_000, maximum=100_000)
        parts = [part.strip() for part in text.split(",")]
        if len(parts) != 2:
            raise BadValue
        return number.parse(parts[0]), number.parse(parts[1])

    def rule(self) -> str:
        """Return what is allowed."""
        return "X and Y in mm with a comma between them, as in 100, 100"

    def stand_in(self) -> tuple[float, float]:
        """Return any place."""
        return (0.0, 0.0)


PLACE: Final = PlaceOption(name="home_xy_position", help="position of the head while Z is homed", unit="mm")
SPEED: Final = speed_option("speed", "of the way there", 50.0)
Z_HOP: Final = FloatOption(
    name="z_hop",
    help="how far the head is lifted before any axis is homed, and its height afterwards, at most"
    " position_max of Z; 0: not at all",
    default=0.0,
    unit="mm",
    minimum=0,
    maximum=MAX_POSITION,
)
Z_HOP_SPEED: Final = speed_option("z_hop_speed", "of the lift", 15.0)
BACK: Final = BoolOption(
    name="move_to_previous",
    help="whether X and Y move back to where they were before Z was homed",
    default=False,
)


class SafeZHome(Module):
    """Replaces G28."""

    SPEC = SectionSpec(
        "G28 homes Z at one position of the bed, after X and Y",
        (PLACE, SPEED, Z_HOP, Z_HOP_SPEED, BACK),
        unsupported=("home_y_before_x",),
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._place = build.get(PLACE)
        self._speed, self._hop_speed = build.get(SPEED), build.get(Z_HOP_SPEED)
        self._hop_mm, self._back = build.get(Z_HOP), build.get(BACK)
        self._limits = build.machine.limits
        top_mm = self._limits.position_max[2]
        if self._hop_mm > top_mm:
            raise build.reader.bad(Z_HOP, f"but Z goes up to {top_mm:g} mm")
        kinematics = build.machine.kinematics
        if not kinematics.straight:
            raise ConfigError(
                build.place,
                f"[{build.name}] has no use on a machine of kinematics {kinematics.name}; remove it",
            )
        self._outside = self._find_outside()
        if self._outside:
            build.note(PLACE, f"is {self._outside}: G28 of Z is refused until it names a place within")
        self._homing = build.shared(Homing)
        self._homing.replace_by(self._read, build)

    def _find_outside(self) -> str:
        """Say what is wrong with the place for Z; empty: nothing."""
        for axis, value in enumerate(self._place):
            low, high = self._limits.position_min[axis], self._limits.position_max[axis]
            if not low <= value <= high:
                x, y = self._place
                return f"{x:g}, {y:g}, but {'XY'[axis]} goes from {low:g} to {high:g} mm"
        return ""

    def _read(self, call: Call, axes: str) -> Reading:
        missing = "".join(axis for axis in "XY" if axis not in call.homed + axes)
        if "Z" in axes and missing:
            raise WordError(f"G28 of Z comes before {missing[0]} is homed; home with G28 first")
        if self._homing.has_lines(axes):
            return Phases(lambda job: self._home_in_phases(job, call, axes))
        return AtStandstill(lambda: self._home(call, axes))

    def _home_in_phases(self, job: ProgramContext, call: Call, axes: str) -> Iterator[Reading]:
        """Do as ``_home``, with the lines that the probe needs around the homing of Z."""
        others = axes.replace("Z", "")
        planned = self._homing.taken_as_home(call, others).position
        assert planned is not None
        before = [planned]

        async def come() -> Done:
            done, now, known = await self._approach_z(call, axes)
            before[0] = known
            return replace(done, position=now.position, homed=others, moved=True)

        yield AtStandstill(come, Done(position=(*self._place, *planned[2:]), homed=others))
        yield from self._homing.home_z_in_phases(job, call.command)
        homed = job.call(call.command)

        async def leave() -> Done:
            return Done(position=(await self._withdraw(homed, before[0])).position, moved=True)

        yield AtStandstill(leave)

    async def _home(self, call: Call, axes: str) -> Done:
        done, call, known = await self._approach_z(call, axes)
        if "Z" in axes:
            call = _after(call, await self._homing.home(call, "Z"))
            call = await self._withdraw(call, known)
        return replace(done, position=call.position, homed=axes, moved=True)

    async def _approach_z(self, call: Call, axes: str) -> tuple[Done, Call, Position]:
        """Home all but Z and go to where Z is homed; return also the place before that."""
        if "Z" in axes and self._outside:
            raise CanductorError(
                f"G28 of Z is refused: home_xy_position of [{self.name}] is {self._outside}; correct it"
            )
        self._homing.check(axes)
        call = await self._lift(call)
        done = Done()
        if others := axes.replace("Z", ""):
            done = await self._homing.home(call, others)
            call = _after(call, done)
        known = call.position
        if "Z" in axes:
            call = await self._go(call, *self._place)
        return done, call, known

    async def _withdraw(self, call: Call, known: Position) -> Call:
        call = await self._lift(call)
        return await self._go(call, known[0], known[1]) if self._back else call

    async def _lift(self, call: Call) -> Call:
        """Lift the head to the height of the hop, or by as much where its height is not known."""
        way_mm = self._hop_mm - (call.position[2] if "Z" in call.homed else 0.0)
        if way_mm <= 0:
            return call
        accel = min(self._limits.max_accel, self._limits.max_z_accel)
        speed = min(self._hop_speed, self._limits.max_z_velocity)
        return await self._move(call, (0.0, 0.0, way_mm), speed, accel)

    async def _go(self, call: Call, x: float, y: float) -> Call:
        way = (x - call.position[0], y - call.position[1], 0.0)
        speed = min(self._speed, self._limits.max_velocity)
        return await self._move(call, way, speed, self._limits.max_accel)

    async def _move(self, call: Call, way: tuple[float, float, float], speed: float, accel: float) -> Call:
        """Move by WAY; return CALL with the place that this led to, by the steps that were made."""
        x, y, z = await move_by(self.live.machine, way, speed, accel)
        at = call.position
        return replace(call, position=(at[0] + x, at[1] + y, at[2] + z, at[3]))


def _after(call: Call, done: Done) -> Call:
    assert done.position is not None
    return replace(call, position=done.position, homed=call.homed + done.homed)

"""G28 with endstops: rails are moved towards them, in the order that the kinematics asks for.

Each rail goes to its endstop at homing_speed, back by homing_retract_dist, and there again at
second_homing_speed. Where it stands then follows from where the endstop is and from the steps made since it
switched, so how far it overshot does not matter; sides of an axis that have endstops of their own are brought
level. A rail without an endstop on a pin is taken as home. What moves when is in homing_plan.py.
"""

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from typing import Final, Protocol

from coordinator.config.errors import ConfigError
from coordinator.config.model import MachineDescription, RailDescription
from coordinator.gcode.commands import AtStandstill, Call, Phases, ProgramContext, Reading
from coordinator.gcode.events import Done
from coordinator.gcode.parser import Command
from coordinator.gcode.reply_kinds import ReplyKind
from coordinator.kinematics.base import Point
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.homing.homing_plan import AXES, Approach, approaches, landed, second_landed
from coordinator.modules.homing.virtual_endstop import ProbeEndstop, StallEndstop, section_of
from coordinator.runtime.machine import Machine
from coordinator.runtime.moves.homing import HomingError, HomingMove, HomingResult
from coordinator.runtime.moves.probing import check_over_bed, in_words_of_the_probe
from coordinator.runtime.moves.single import Ramp, SingleMove
from coordinator.runtime.moves.straight import move_by
from coordinator.support.values import Value
from nodes.support.errors import CanductorError

AWAY_MM: Final = 5.0
"""How far a rail that stands on its endstop goes away first, where homing_retract_dist is 0."""
BELOW_MM: Final = 0.5
"""How far below position_min the second approach of a probe may lead: its first one may have been lower."""


ReadHome = Callable[[Call, str], Reading]


class TriggerPhase(Protocol):
    """What knows better at which step an endstop switched."""

    async def before(self) -> None:
        """Take note of how a stepper stands before a move towards its endstop; raises CanductorError."""

    async def beyond_mm(self, result: HomingResult) -> float:
        """Return by how much further beyond the trigger of RESULT the rail stands; raises CanductorError."""


class Homing(Module):
    """Homes the machine that it is built for."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.name = "query_endstops"
        self._described = build.machine
        self._last_query: dict[str, bool] = {}
        self._approaches = approaches(build.machine)
        self._feelers: dict[str, StallEndstop] = {}
        """By virtual endstop."""
        self.instead: Callable[[Call, str], Reading] | None = None
        """Reads G28 instead; a G28 among the lines that replace it homes."""
        self.corrected: Callable[[ReadHome], ReadHome] | None = None
        """Converts the result of homing, for programs whose X Y Z are not those of the axes."""
        self._probe: ProbeEndstop | None = None
        self.trigger_phases: dict[str, TriggerPhase] = {}
        """By the first stepper of a rail."""
        self.when_homed: list[Callable[[str], None]] = []
        """Called with the letters of the axes that are homed."""
        build.add_command("M119", "Report which endstops are pressed", self._read_query)
        build.add_command("QUERY_ENDSTOPS", "Report which endstops are pressed", self._read_query)

    def follow(self, described: MachineDescription) -> None:
        """Home the machine as it is DESCRIBED now: its motors follow other sums of the axes."""
        self._described = described
        self._approaches = approaches(described)

    def status(self) -> Mapping[str, Value]:
        """Report which endstops were pressed at the last query."""
        return {"last_query": dict(self._last_query)}

    @property
    def acts(self) -> bool:
        """Whether there is any endstop to home to."""
        return self.instead is not None or any(
            approach.possible or self._refusal(approach) for approach in self._approaches
        )

    def replace_by(self, read: Callable[[Call, str], Reading], build: Build) -> None:
        """Let READ read G28, for the section of BUILD; raises ConfigError when another section does."""
        if self.instead is not None:
            raise ConfigError(
                build.place,
                f"[{build.name}] and another section both replace G28; remove one:"
                " [homing_override] can do what [safe_z_home] does",
            )
        self.instead = read

    def link(self, modules: Modules) -> None:
        """Find the drivers for sensorless homing, and the probe that is the endstop of Z."""
        if self._by_probe:
            self._probe = next(modules.of(ProbeEndstop), None)
        for rail in (rail for approach in self._approaches for rail in approach.rails):
            virtual = rail.homing.virtual_endstop
            found = modules.find(section_of(virtual), StallEndstop) if virtual else None
            if found is not None:
                self._feelers[virtual] = found

    def read(self, call: Call, axes: str) -> Reading:
        """Read G28 of AXES (letters)."""
        if self.instead is not None and "G28" not in call.callers:
            return self.instead(call, axes)
        if not self.has_lines(axes):
            return AtStandstill(lambda: self.home(call, axes))
        return Phases(lambda job: self._home_in_phases(job, call.command, axes))

    def has_lines(self, axes: str) -> bool:
        """Return whether homing AXES (letters) has to run lines of g-code on the way."""
        return "Z" in axes and self._probe is not None and self._probe.has_lines

    def _home_in_phases(self, job: ProgramContext, command: Command, axes: str) -> Iterator[Reading]:
        if others := axes.replace("Z", ""):
            call = job.call(command)
            yield AtStandstill(lambda: self.home(call, others), self.taken_as_home(call, others))
        yield from self.home_z_in_phases(job, command)

    def home_z_in_phases(self, job: ProgramContext, command: Command) -> Iterator[Reading]:
        """Home Z with the lines that its probe needs."""
        assert self._probe is not None
        yield self._probe.lines_before(job.call(command))
        call = job.call(command)
        yield AtStandstill(lambda: self.home(call, "Z"), self.taken_as_home(call, "Z"))
        yield self._probe.lines_after(job.call(command))

    def taken_as_home(self, call: Call, axes: str) -> Done:
        """Return what a program that is only planned takes to come of homing AXES."""
        x, y, z = (
            home if letter in axes else at
            for letter, home, at in zip("XYZ", self._described.home, call.position[:3], strict=True)
        )
        return Done(position=(x, y, z, call.position[3]), homed=axes)

    # ---------------------------------------------------------------------------------------------- homing

    def check(self, axes: str) -> None:
        """Raise CanductorError, before anything moves, if one of AXES (letters) cannot be homed."""
        for approach in self._approaches:
            if set(approach.letters) & set(axes.upper()) and (why := self._refusal(approach)):
                raise CanductorError(f"G28 of {approach.letters} is refused: {why}")

    def _refusal(self, approach: Approach) -> str:
        """Return why the axes of APPROACH cannot be homed; empty: they can."""
        for rail in approach.rails:
            if rail.homing.refused:
                return rail.homing.refused
            if rail.homing.waits:
                return (
                    f"the endstop {rail.homing.virtual_endstop} ({rail.place}) is not supported yet; give the"
                    " axis a switch as its endstop_pin, or add [probe]"
                )
        for stepper in self._described.motors:
            if stepper.name in approach.ways and stepper.unpowered:
                return f"{stepper.unpowered}, so the motor {stepper.name} cannot be switched on"
        return ""

    async def home(self, call: Call, axes: str) -> Done:
        """Home AXES (letters) from where CALL says that the machine stands; raises CanductorError."""
        self.check(axes)
        described = self._described
        self._check_over_bed(call, axes)
        home = dict(zip("XYZ", described.home, strict=True))
        x, y, z, e = call.position
        place = (x, y, z)
        homed, second_mm = set(axes.upper()), None
        for approach in self._approaches:
            if not set(approach.letters) & set(axes.upper()):
                continue
            homed |= set(approach.letters)
            if not approach.possible:
                x, y, z = (
                    home[letter] if letter in approach.letters else at
                    for letter, at in zip("XYZ", place, strict=True)
                )
                place = (x, y, z)
                continue
            beyond_mm = await self._approach(approach)
            y = place[1] if "Y" in call.homed else home["Y"]  # of a Y that towers do not move
            found = landed(described, approach, beyond_mm, place, y)
            if approach.is_second_carriage:
                second_mm = second_landed(approach, beyond_mm)
            else:
                place = found
        letters = "".join(letter for letter in "XYZ" if letter in homed)
        for call_back in self.when_homed:
            call_back(letters)
        place = await self._come_within(place, letters)
        return Done(position=(*place, e), homed=letters, moved=True, second_carriage_mm=second_mm)

    def _check_over_bed(self, call: Call, axes: str) -> None:
        """Raise CanductorError, before anything moves, where the probe would miss the bed."""
        probe = self._described.probe
        if probe is None or not self._by_probe or "Z" not in axes:
            return
        known = set(call.homed) | set(axes)
        missing = next((letter for letter in "XY" if letter not in known), "")
        if missing:
            raise CanductorError(f"G28 of Z comes before {missing} is homed; home with G28 first")
        place = self.taken_as_home(call, axes).position
        assert place is not None
        if why := check_over_bed(self._described, probe, place[0], place[1]):
            raise CanductorError(
                f"G28 of Z is refused: {why}; add [safe_z_home], or move the head there before"
            )

    @property
    def _by_probe(self) -> bool:
        probe = self._described.probe
        return probe is not None and probe.rail.axis == "z"

    async def _approach(self, approach: Approach) -> list[float]:
        """Go to the endstops, twice if so configured; return how far beyond each trigger the rails stand."""
        rail = approach.rails[0]
        homing = rail.homing
        if await self._any_pressed([rail for rail in approach.rails if not self._feels(rail)]):
            await self._go_back(approach)
        most_mm, speed = approach.most_mm, homing.speed
        if homing.retract_distance:
            await self._move(approach, most_mm, speed)
            await self._go_back(approach)
            most_mm, speed = self._most_again_mm(rail), homing.second_speed
        beyond_mm = await self._beyond_mm(approach, most_mm, speed)
        if self._probe is not None and homing.by_probe:
            beyond_mm = await self._measured(approach, beyond_mm)
        if rail.axis in AXES:
            await self._align(approach, beyond_mm)
        return beyond_mm

    async def _beyond_mm(self, approach: Approach, way_mm: float, speed: float) -> list[float]:
        """Go to the endstops for the last time; return how far beyond each trigger the rails stand."""
        phases = [self.trigger_phases.get(rail.steppers[0].name) for rail in approach.rails]
        for phase in phases:
            if phase is not None:
                await phase.before()
        results = await self._move(approach, way_mm, speed)
        return [
            result.beyond_trigger_mm + (0.0 if phase is None else await phase.beyond_mm(result))
            for result, phase in zip(results, phases, strict=True)
        ]

    async def _measured(self, approach: Approach, beyond_mm: list[float]) -> list[float]:
        """Return BEYOND_MM, or what follows from the height that the probe measures at standstill."""
        assert self._probe is not None
        try:
            height_mm = await self._probe.standing_mm()
        except CanductorError as error:
            if self._machine.stopped is not None:
                raise
            raise HomingError(
                f"Z was not homed: {error}; the head was lowered to about"
                f" {approach.rails[0].homing.position_endstop:g} mm above the bed"
            ) from error
        trigger_mm = approach.rails[0].homing.position_endstop
        return beyond_mm if height_mm is None or trigger_mm is None else [trigger_mm - height_mm]

    @staticmethod
    def _most_again_mm(rail: RailDescription) -> float:
        """Return how far the second approach may go; a probe is not lowered beyond the end of Z for long."""
        most_mm = 2 * rail.homing.retract_distance + AWAY_MM
        if (
            rail.homing.by_probe
            and rail.position_min is not None
            and rail.homing.position_endstop is not None
        ):
            room_mm = rail.homing.position_endstop - rail.position_min
            most_mm = min(most_mm, rail.homing.retract_distance + room_mm + BELOW_MM)
        return most_mm

    async def _come_within(self, place: "Point", letters: str) -> "Point":
        """Move axes that stopped behind their endstop beyond their range back into it; return where they are.

        By a step more than needed, as moves are made of whole steps. Towers and arms end within their space.
        """
        described = self._described
        if self._live is None or not described.kinematics.straight:
            return place
        for axis, letter in enumerate("XYZ"):
            way_mm = self._way_within(axis, place[axis]) if letter in letters else 0.0
            if not way_mm:
                continue
            x, y, z = (way_mm if number == axis else 0.0 for number in range(3))
            rail = next(rail for rail in described.rails if rail.axis == letter.lower())
            speed, accel = rail.homing.retract_speed, self._accel(rail.axis, rail)
            made = await move_by(self._machine, (x, y, z), speed, accel)
            place = (place[0] + made[0], place[1] + made[1], place[2] + made[2])
        return place

    def _way_within(self, axis: int, at_mm: float) -> float:
        space, motors = self._described.kinematics.work_space, self._described.motors
        low, high = space.low[axis], space.high[axis]
        if low <= at_mm <= high:
            return 0.0
        step_mm = max(m.step_distance / abs(m.weights[axis]) for m in motors if m.weights[axis])
        return low - at_mm + step_mm if at_mm < low else high - at_mm - step_mm

    async def _align(self, approach: Approach, beyond_mm: Sequence[float]) -> None:
        """Bring the sides of an axis as far beyond their endstops as its first one is."""
        for rail, beyond in zip(approach.rails[1:], beyond_mm[1:], strict=True):
            way_mm = beyond_mm[0] - beyond
            ways = {
                stepper.name: math.copysign(approach.ways[stepper.name], way_mm * approach.ways[stepper.name])
                for stepper in rail.steppers
            }
            if abs(way_mm) >= rail.steppers[0].step_distance / 2:
                await self._go(approach, ways, abs(way_mm))

    async def _move(self, approach: Approach, way_mm: float, speed: float) -> "Sequence[HomingResult]":
        async with contextlib.AsyncExitStack() as stack:
            for rail in approach.rails:
                if (feeler := self._feels(rail)) is not None:
                    await stack.enter_async_context(feeler.feeling(speed))
            move = HomingMove(
                self._machine,
                approach.rails,
                ways=approach.ways,
                way_mm=way_mm,
                speed=speed,
                accel=self._approach_accel(approach),
            )
            try:
                async with self._touching(approach):
                    return await move.run()
            except HomingError as error:
                if not approach.rails[0].homing.by_probe:
                    raise
                raise HomingError(
                    f"Z was not homed: {in_words_of_the_probe(error)}; the head was lowered by"
                    f" {move.planned_way_mm:.3f} mm"
                ) from error

    def _touching(self, approach: Approach) -> AbstractAsyncContextManager[None]:
        if self._probe is None or not approach.rails[0].homing.by_probe:
            return contextlib.nullcontext()
        return self._probe.touching(alone=True)

    def _feels(self, rail: "RailDescription") -> StallEndstop | None:
        return self._feelers.get(rail.homing.virtual_endstop)

    async def _go_back(self, approach: Approach) -> None:
        ways = {name: -way for name, way in approach.ways.items()}
        await self._go(approach, ways, approach.rails[0].homing.retract_distance or AWAY_MM)

    async def _go(self, approach: Approach, ways: Mapping[str, float], way_mm: float) -> None:
        rail = approach.rails[0]
        ramp = Ramp(way_mm, rail.homing.retract_speed, self._accel(approach.axis, rail))
        await SingleMove(self._machine, ramp, ways=ways).run()

    def _approach_accel(self, approach: Approach) -> float:
        accel = self._accel(approach.axis, approach.rails[0])
        if self._probe is None or not approach.rails[0].homing.by_probe:
            return accel
        return min(accel, self._probe.probing_accel or accel)

    def _accel(self, axis: str, rail: "RailDescription") -> float:
        limits = self._described.limits
        most = min(limits.max_accel, limits.max_z_accel) if axis == "z" else limits.max_accel
        return min(most, rail.homing.accel or most)

    # ------------------------------------------------------------------------------------------- endstops

    def _read_query(self, _: Call) -> Reading:
        return AtStandstill(self._query)

    async def _query(self) -> Done:
        rails = [rail for rail in self._described.stops if rail.axis != "probe"]
        self._last_query = {rail.axis: await self._pressed(rail) for rail in rails}
        states = [f"{axis}:{'pressed' if pressed else 'open'}" for axis, pressed in self._last_query.items()]
        return Done((" ".join(states) or "this machine has no endstops on pins",), kind=ReplyKind.PLAIN)

    async def _any_pressed(self, rails: Sequence["RailDescription"]) -> bool:
        return any([await self._pressed(rail) for rail in rails])

    async def _pressed(self, rail: "RailDescription") -> bool:
        devices = self._machine.devices
        state = await devices.endstops[rail.axis].state(self._machine.nodes[devices.endstop_node(rail)])
        return state.pressed

    @property
    def _machine(self) -> "Machine":
        return self.live.machine

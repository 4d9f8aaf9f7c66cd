"""G28 with endstops: rails are moved towards them, in the order that the kinematics asks for.

Each rail goes to its endstop at homing_speed, back by homing_retract_dist, and there again at
second_homing_speed. Where it stands then follows from where the endstop is and from the steps made since it
switched, so how far it overshot does not matter. A rail without an endstop on a pin is taken as home.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final

from coordinator.gcode.commands import AtRest, Call, Done, GCodeCommand, Reading
from coordinator.machine.options import SectionSpec
from coordinator.machine.problem import ConfigError
from coordinator.modules.base import Build, Module
from nodes.errors import CanductorError

if TYPE_CHECKING:
    from coordinator.app import Machine
    from coordinator.homing import HomingMove
    from coordinator.machine.model import RailDescription
    from coordinator.modules.live import Live

WAY_SHARE: Final = 1.5
"""An endstop has to switch within so many lengths of its axis."""
AWAY_MM: Final = 5.0
"""How far a rail that stands on its endstop goes away first, where homing_retract_dist is 0."""
_AXES: Final = ("x", "y", "z")
_TOWERS: Final = ("delta", "deltesian")
"""Kinematics whose rails go up together, with the head."""


class Homing(Module):
    """Homes the machine that it is built for."""

    SPEC = SectionSpec(help="Homing", options=())

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._described = build.machine
        self._live: Live | None = None
        self.instead: Callable[[Call, str], Reading] | None = None
        """Reads G28 in its place; a G28 among the lines that it stands for is homing again."""
        build.add_command(GCodeCommand("M119", "Tell which endstops are pressed", self._read_query))
        build.add_command(GCodeCommand("QUERY_ENDSTOPS", "Tell which endstops are pressed", self._read_query))

    @property
    def acts(self) -> bool:
        """Whether there is any endstop that it can look for."""
        return self.instead is not None or any(self._can_home(rails) for rails, _ in self._groups())

    def replace_by(self, read: Callable[[Call, str], Reading], build: Build) -> None:
        """Have READ read G28, for the section that BUILD is of; raises ConfigError when another does."""
        if self.instead is not None:
            raise ConfigError(
                build.place,
                f"[{build.name}] and another section both say what G28 does; remove one:"
                " [homing_override] can do what [safe_z_home] does",
            )
        self.instead = read

    async def connect(self, live: "Live") -> None:
        """Take over the machine."""
        self._live = live

    def read(self, call: Call, axes: str) -> Reading:
        """Read G28 of AXES (letters)."""
        if self.instead is not None and "G28" not in call.callers:
            return self.instead(call, axes)
        return AtRest(lambda: self.home(call, axes))

    # ----------------------------------------------------------------------------------------- which rails

    def _groups(self) -> list[tuple[list["RailDescription"], str]]:
        """Return the rails that are homed one after the other, each with the axis it moves the head along."""
        described = self._described
        rails = {rail.axis: rail for rail in described.rails}
        groups = []
        for names in described.kinematics.homing_order:
            found = [rails[name] for name in names if name in rails]
            towers = described.kinematics.name in _TOWERS and len(names) > 1
            axis = "z" if towers else names[0]
            if found and axis in _AXES:
                groups.append((found, axis))
        return groups

    def _can_home(self, rails: Sequence["RailDescription"]) -> bool:
        return all(rail.homing.endstop_pin is not None for rail in rails)

    # ---------------------------------------------------------------------------------------------- homing

    async def home(self, call: Call, axes: str) -> Done:
        """Home AXES (letters) from where CALL says that the machine stands; raises CanductorError."""
        described = self._described
        home = dict(zip(_AXES, described.home, strict=True))
        place = dict(zip(_AXES, call.position[:3], strict=True))
        homed: set[str] = set()
        for rails, axis in self._groups():
            wanted = set(_AXES) if len(rails) > 1 else {axis}
            if not wanted & set(axes.lower()):
                continue
            if not self._can_home(rails):
                place.update({name: home[name] for name in wanted})
            elif len(rails) > 1:
                y = place["y"] if "Y" in call.homed else home["y"]
                place.update(zip(_AXES, await self._home_towers(rails, y), strict=True))
            else:
                place[axis] = await self._home_axis(rails[0], axis)
            homed |= wanted
        homed |= set(axes.lower()) - homed
        position = (place["x"], place["y"], place["z"], call.position[3])
        letters = "".join(axis.upper() for axis in _AXES if axis in homed)
        return Done(position=position, homed=letters, moved=True)

    async def _home_axis(self, rail: "RailDescription", axis: str) -> float:
        """Return where the axis stands."""
        direction = 1 if rail.homing.positive_dir else -1
        (beyond_mm,) = await self._approach([rail], axis, direction)
        assert rail.homing.position_endstop is not None
        return rail.homing.position_endstop + direction * beyond_mm

    async def _home_towers(self, rails: Sequence["RailDescription"], y: float) -> tuple[float, float, float]:
        """Return where the head stands, Y being Y if it has a rail of its own."""
        beyond_mm = await self._approach(rails, "z", 1)
        kinematics = self._described.kinematics
        ends: tuple[float, ...] = kinematics.endstop_positions  # type: ignore[attr-defined]
        heights = [end + beyond for end, beyond in zip(ends, beyond_mm, strict=True)]
        return kinematics.forward((*heights, *(() if len(heights) == len(kinematics.rails) else (y,))))

    async def _approach(self, rails: Sequence["RailDescription"], axis: str, direction: int) -> list[float]:
        """Go to the endstops, twice if so configured; return how far beyond each trigger the rails stand."""
        homing = rails[0].homing
        space = self._described.kinematics.work_space
        at = _AXES.index(axis)
        if await self._any_pressed(rails):
            await self._go_back(rails, axis, -direction)
        way_mm = WAY_SHARE * (space.high[at] - space.low[at])
        results = await self._move(rails, axis, direction, way_mm, homing.speed).run()
        if homing.retract_distance:
            await self._go_back(rails, axis, -direction)
            way_mm = 2 * homing.retract_distance + AWAY_MM
            results = await self._move(rails, axis, direction, way_mm, homing.second_speed).run()
        return [result.beyond_trigger_mm for result in results]

    def _move(
        self, rails: Sequence["RailDescription"], axis: str, direction: int, way_mm: float, speed: float
    ) -> "HomingMove":
        from coordinator.homing import HomingMove  # noqa: PLC0415 (planning needs no asyncio)

        return HomingMove(
            self._machine,
            rails,
            axis=axis,
            direction=direction,
            way_mm=way_mm,
            speed=speed,
            accel=self._accel(axis, rails[0]),
        )

    async def _go_back(self, rails: Sequence["RailDescription"], axis: str, direction: int) -> None:
        from coordinator.single_move import Ramp, SingleMove, ratio_of  # noqa: PLC0415 (as above)

        homing = rails[0].homing
        way_mm = homing.retract_distance or AWAY_MM
        ramp = Ramp(way_mm, homing.retract_speed, self._accel(axis, rails[0]))
        await SingleMove(self._machine, ramp, ratio_of(axis, direction)).run()

    def _accel(self, axis: str, rail: "RailDescription") -> float:
        limits = self._described.limits
        most = min(limits.max_accel, limits.max_z_accel) if axis == "z" else limits.max_accel
        return min(most, rail.homing.accel or most)

    # ------------------------------------------------------------------------------------------- endstops

    def _read_query(self, _: Call) -> Reading:
        return AtRest(self._query)

    async def _query(self) -> Done:
        rails = [rail for rail in self._described.rails if rail.homing.endstop_pin is not None]
        told = [f"{rail.axis}:{'pressed' if await self._pressed(rail) else 'open'}" for rail in rails]
        return Done((" ".join(told) or "this machine has no endstops on pins",))

    async def _any_pressed(self, rails: Sequence["RailDescription"]) -> bool:
        return any([await self._pressed(rail) for rail in rails])

    async def _pressed(self, rail: "RailDescription") -> bool:
        devices = self._machine.devices
        state = await devices.endstops[rail.axis].state(self._machine.nodes[devices.endstop_node(rail)])
        return state.pressed

    @property
    def _machine(self) -> "Machine":
        if self._live is None:
            raise CanductorError("homing needs a machine that is connected")
        return self._live.machine

"""A machine whose homing moves are kept instead of made: their order and figures are what is tested."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from coordinator.assembly.load import load_machine
from coordinator.gcode.commands import AtStandstill, Call, Reading
from coordinator.gcode.events import Done
from coordinator.gcode.parser import parse
from coordinator.modules.homing.homing import Homing
from coordinator.modules.homing.virtual_endstop import StallEndstop
from coordinator.modules.module_set import build_modules

if TYPE_CHECKING:
    from coordinator.runtime.module_context import ModuleContext
    from coordinator.runtime.moves.single import Ramp

Way = tuple[float, float, float]


def perform(reading: Reading) -> Done:
    """Carry out what is done at rest; return what came of it."""
    assert isinstance(reading, AtStandstill)

    async def main() -> Done | None:
        return await reading.perform()

    done = asyncio.run(main())
    assert done is not None
    return done


@dataclass(frozen=True)
class To:
    """A move towards the endstops of RAILS."""

    rails: tuple[str, ...]
    ways: Mapping[str, float]
    most_mm: float
    speed: float
    accel: float


@dataclass(frozen=True)
class Motors:
    """A move of motors, at most WAY_MM of way."""

    ways: Mapping[str, float]
    way_mm: float
    speed: float
    accel: float


@dataclass(frozen=True)
class Head:
    """A move of the head by WAY."""

    way: Way
    speed: float
    accel: float


@dataclass(frozen=True)
class Feels:
    """The driver of SECTION feels its motor at SPEED, or no longer does."""

    section: str
    speed: float
    on: bool


class HomingStage:
    """The machine of the file at PATH, connected unless LIVE is False.

    BEYOND: by rail, how far beyond its endstop it stands after a homing move. PRESSED: rails whose endstops
    are pressed. MADE: what is made of a move of the head, beside what is asked for.
    """

    def __init__(self, path: str, monkeypatch: pytest.MonkeyPatch, *, live: bool = True) -> None:
        self.described = load_machine(path)
        self.modules = build_modules(self.described)
        homing = self.modules.find("query_endstops", Homing)
        assert homing is not None
        self.homing = homing
        self.moves: list[To | Motors | Head | Feels] = []
        self.beyond: dict[str, float] = {}
        self.pressed: set[str] = set()
        self.looked_at: list[str] = []
        self.made: Way = (0.0, 0.0, 0.0)
        stage = self

        class Homes:
            def __init__(self, machine: object, rails: Sequence[Any], **options: Any) -> None:
                assert machine is stage.machine
                names = tuple(rail.axis for rail in rails)
                figures = (options[name] for name in ("ways", "way_mm", "speed", "accel"))
                stage.moves.append(To(names, *figures))
                self._names = names

            async def run(self) -> list[SimpleNamespace]:
                return [
                    SimpleNamespace(beyond_trigger_mm=stage.beyond.get(name, 0.0)) for name in self._names
                ]

        class Goes:
            def __init__(self, machine: object, ramp: "Ramp", *, ways: Mapping[str, float]) -> None:
                assert machine is stage.machine
                self._move = Motors(ways, ramp.way_mm, ramp.speed, ramp.accel)

            async def run(self) -> None:
                stage.moves.append(self._move)

        async def move_by(machine: object, way: Way, speed: float, accel: float) -> Way:
            assert machine is stage.machine
            stage.moves.append(Head(way, speed, accel))
            x, y, z = (asked + more for asked, more in zip(way, stage.made, strict=True))
            return x, y, z

        monkeypatch.setattr("coordinator.modules.homing.homing.HomingMove", Homes)
        monkeypatch.setattr("coordinator.modules.homing.homing.SingleMove", Goes)
        monkeypatch.setattr("coordinator.modules.homing.homing.move_by", move_by)
        monkeypatch.setattr("coordinator.modules.homing.safe_z_home.move_by", move_by)
        self.machine = SimpleNamespace(
            devices=SimpleNamespace(
                endstops={rail.axis: _Endstop(self, rail.axis) for rail in self.described.stops},
                endstop_node=lambda rail: f"node of {rail.axis}",
            ),
            nodes={f"node of {rail.axis}": f"node of {rail.axis}" for rail in self.described.stops},
        )
        for feeler in self.modules.of(StallEndstop):
            monkeypatch.setattr(feeler, "feeling", lambda speed, f=feeler: self._feeling(f.name, speed))
        self.live = cast("ModuleContext", SimpleNamespace(machine=self.machine))
        if live:
            asyncio.run(homing.connect(self.live))

    @contextlib.asynccontextmanager
    async def _feeling(self, section: str, speed: float) -> AsyncIterator[None]:
        self.moves.append(Feels(section, speed, on=True))
        yield
        self.moves.append(Feels(section, speed, on=False))

    @staticmethod
    def call(
        line: str, place: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0), homed: str = ""
    ) -> Call:
        command = parse(line.encode())
        assert command is not None
        return Call(command, 1, place, homed)


class _Endstop:
    def __init__(self, stage: HomingStage, axis: str) -> None:
        self._stage, self._axis = stage, axis

    async def state(self, node: object) -> SimpleNamespace:
        assert node == f"node of {self._axis}"
        self._stage.looked_at.append(self._axis)
        return SimpleNamespace(pressed=self._axis in self._stage.pressed)

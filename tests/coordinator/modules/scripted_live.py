"""A live machine for one heater, whose clocks, nodes and filament the test scripts; what it sends is kept."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, cast

from coordinator.modules.heaters.heater import Heater
from coordinator.modules.heaters.heaters import HeaterRegistry
from nodes.node.errors import NodeError
from nodes.node.states import NodeState
from tests.stages.heat_machine import build, configured

if TYPE_CHECKING:
    from coordinator.runtime.module_context import ModuleContext

TICKS_PER_S = 1000
PRINT_OFFSET_S = 100.0
"""Print time is ahead of the host's time by so much."""
FULL_TICKS = 16_800_000
"""On all the time: a cycle of 0.1 s on the node of the firmware's dictionary."""


class Board:
    """A node that keeps what it is sent: (print time in s, share of the time on)."""

    def __init__(self) -> None:
        self.state = NodeState.READY
        self.output_slots = 1000
        self.sent: list[tuple[float, float]] = []
        self.broken: str | None = None

    def check_ready(self) -> None:
        assert self.state is NodeState.READY

    def send(self, command: str, *, req_clock: int, oid: int, clock: int, on_ticks: int) -> None:
        assert (command, oid >= 0, clock) == ("queue_digital_out", True, req_clock)
        if self.broken is not None:
            raise NodeError(self.broken)
        self.sent.append((clock / TICKS_PER_S, round(on_ticks / FULL_TICKS, 6)))


class Filament:
    """A forecast that is always MM_PER_S, and keeps what it is asked."""

    def __init__(self) -> None:
        self.mm_per_s_now = 0.0
        self.wanted: list[str] = []
        self.asked: list[tuple[str, float, float]] = []

    def want(self, extruder: str) -> None:
        self.wanted.append(extruder)

    def mm_per_s(self, extruder: str, begin_s: float, end_s: float) -> float:
        self.asked.append((extruder, begin_s, end_s))
        return self.mm_per_s_now


class ScriptedLive:
    """What a heater asks of a live machine. HOST_S is the host's time."""

    def __init__(self) -> None:
        self.host_s = 10.0
        self.nodes = {"mcu": Board(), "toolhead": Board()}
        self.filament = Filament()
        self.said: list[str] = []
        self.stops: list[str] = []
        self.saved: list[tuple[str, str, str]] = []
        self.timers: list[tuple[float, Callable[[], None]]] = []
        self.later: list[tuple[float, Callable[[], None]]] = []

    @property
    def machine(self) -> "ScriptedLive":
        return self

    @property
    def live(self) -> "ModuleContext":
        return cast("ModuleContext", self)

    def node(self, name: str) -> Board:
        return self.nodes[name]

    def now_s(self) -> float:
        return self.host_s

    def print_time_now(self) -> float:
        return self.host_s + PRINT_OFFSET_S

    def ticks_in(self, node: str, seconds: float) -> int:
        assert node in self.nodes
        return round((self.print_time_now() + seconds) * TICKS_PER_S)

    def every(self, seconds: float, call: Callable[[], None]) -> None:
        self.timers.append((seconds, call))

    def after(self, least_s: float, call: Callable[[], None], most_s: float = 0.0) -> Callable[[], None]:
        self.later.append((max(least_s, most_s), call))
        return lambda: None

    def save(self, section: str, option: str, text: str) -> None:
        self.saved.append((section, option, text))

    def stop(self, cause: str) -> None:
        self.stops.append(cause)

    def say(self, sentence: str) -> None:
        self.said.append(sentence)


def heater(folder: Path, text: str, key: str = "extruder") -> Heater:
    """Return heater KEY of the machine of TEXT, which follows BASE; it is not connected."""
    modules = build(folder, text)
    configured(modules, "toolhead")
    configured(modules, "mcu")
    heaters = modules.find("heaters", HeaterRegistry)
    assert heaters is not None
    return heaters.units[key]


class Driven:
    """UNIT on a live machine, measured and looked after by the test."""

    def __init__(self, unit: Heater, celsius: float | None = 20.0) -> None:
        self.unit = unit
        self.live = ScriptedLive()
        self.board = self.live.nodes[unit.node]
        unit.input.celsius = celsius  # it waits for no first measurement, and has taken none
        asyncio.run(unit.connect(self.live.live))

    @property
    def sent(self) -> list[tuple[float, float]]:
        """What the heater's node was sent: (print time in s, share of the time on)."""
        return self.board.sent

    def measured(self, celsius: float, at_s: float | None = None) -> float:
        """Give it a measurement, now or at a print time; return the power that follows."""
        when_s = self.live.print_time_now() if at_s is None else at_s
        self.unit.input._take(celsius, lambda _: when_s)
        return self.unit.power

    def look(self) -> None:
        """Let the two looks come that it has asked for."""
        for _, call in self.live.timers:
            call()

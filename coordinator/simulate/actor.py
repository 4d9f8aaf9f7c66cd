"""Carries out the faults of a scenario, in the true time of the world."""

import random
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

from coordinator.simulate.boards import Board
from coordinator.simulate.faults import NS, ScenarioFault
from coordinator.simulate.scenario import HOST
from coordinator.simulate.script import ScriptedWorld
from coordinator.support.toml_values import ScenarioError
from nodes.support._wire import ffi, lib
from nodes.support.can_protocol import FIRST_DATA_ID
from nodes.virtual.plant_page import PlantFault as State
from nodes.virtual.plant_page import PlantItemKind
from nodes.virtual.sim_plant import SimPlant
from nodes.virtual.world import CanController, CanPort, CanWire, Uart, UartPort

FRAME_BITS: Final = 110
"""Bits of a typical frame: converts a ratio of frames to a ratio of bits."""
BABBLE: Final = b"\xff" * 8
FRAME_BYTES: Final = 8
FLOOD_NS: Final = 2_000_000
"""A flood of bytes is put on the line in portions of such a time."""


def bit_errors(share: float) -> float:
    """Return the probability of a disturbed bit that disturbs SHARE of the frames."""
    return float(1.0 - (1.0 - share) ** (1.0 / FRAME_BITS))


def _block(content: bytes, sequence: int) -> bytes:
    out = ffi.new("uint8_t[64]")
    ffi.memmove(out + lib.WIRE_HEADER, content, len(content))
    return bytes(ffi.buffer(out, lib.wire_block_finish(out, len(content), sequence)))


class SimActor:
    """Changes the parts of WORLD; NAME is the scenario's, for messages. The mappings may still grow."""

    def __init__(
        self,
        name: str,
        world: ScriptedWorld,
        boards: Mapping[str, Board],
        wires: Mapping[str, CanWire | Uart],
        ports: Mapping[str, CanPort | UartPort],
        *,
        plants: Mapping[str, SimPlant],
    ) -> None:
        self._name = name
        self._world = world
        self._boards = boards
        self._wires = wires
        self._ports = ports
        self._plants = plants
        self._acts: dict[str, Callable[[ScenarioFault, bool], None]] = {
            "cut": self._cut,
            "reset": self._reset,
            "power": self._power,
            "stall": self._stall,
            "babble": self._babble,
            "forge": self._forge,
            "block": self._forge_block,
            "lie": self._lie,
            "flood": self._flood,
            "loss": self._rate,
            "corruption": self._rate,
            "errors": self._disturb,
            "sensor": self._open_sensors,
        }

    def now_ns(self) -> int:
        """Return true time."""
        return self._world.now_ns

    def call(self, at_ns: int, what: Callable[[], object]) -> None:
        """Call WHAT at AT_NS, and continue the host after it."""
        self._world.at(at_ns, what, wakes=True)

    def act(self, fault: ScenarioFault) -> None:
        """Schedule the start and the end of FAULT."""
        act = self._acts[fault.kind]
        if fault.node and not (fault.node == HOST and fault.kind == "stall"):
            self._board(fault)  # an unknown node is reported now, not during the run
        if fault.bus and fault.bus not in self._wires:
            raise ScenarioError(
                f"{self._name}: a fault names the bus '{fault.bus}', which the machine does not have"
            )
        self._world.at(fault.begin_ns, partial(act, fault, True))
        self._world.at(fault.end_ns, partial(act, fault, False))

    def _board(self, fault: ScenarioFault) -> Board:
        if fault.node not in self._boards:
            known = ", ".join(self._boards)
            raise ScenarioError(f"{self._name}: a fault names the node '{fault.node}'; there are {known}")
        return self._boards[fault.node]

    def _cut(self, fault: ScenarioFault, begins: bool) -> None:
        board = self._board(fault)
        if board.node.controller is not None:
            board.node.controller.cut(int(begins))
        elif isinstance(board.wire, Uart):
            board.wire.set_faults(loss=float(begins))

    def _reset(self, fault: ScenarioFault, begins: bool) -> None:
        if begins:
            self._board(fault).node.reset()

    def _power(self, fault: ScenarioFault, begins: bool) -> None:
        node = self._board(fault).node
        if begins:
            node.power_off()
        else:
            node.power_on()

    def _stall(self, fault: ScenarioFault, begins: bool) -> None:
        duration_s = (fault.end_ns - fault.begin_ns) / NS
        if not begins:
            return
        if fault.node == HOST:
            self._world.stall(duration_s)
        else:
            self._board(fault).stall(duration_s)

    def _controller(self, fault: ScenarioFault) -> CanController:
        controller = self._board(fault).node.controller
        if controller is None:
            raise ScenarioError(f"{self._name}: the node '{fault.node}' is on a UART and cannot {fault.kind}")
        return controller

    def _forge(self, fault: ScenarioFault, begins: bool) -> None:
        if begins:
            self._controller(fault).send(fault.can_id, fault.data)

    def _forge_block(self, fault: ScenarioFault, begins: bool) -> None:
        sender = self._controller(fault)
        if not begins:
            return
        nodeid = (fault.can_id - FIRST_DATA_ID) // 2
        for board in self._boards.values():
            if board.wire is self._board(fault).wire and board.node.expected[0] == nodeid:
                block = _block(fault.data, board.node.expected[1])
                for at in range(0, len(block), FRAME_BYTES):
                    sender.send(fault.can_id, block[at : at + FRAME_BYTES])

    def _lie(self, fault: ScenarioFault, begins: bool) -> None:
        board = self._board(fault)
        if begins:
            board.node.lie(board.clock_hz, fault.wrong_s, fault.random_s)
        else:
            board.node.lie(board.clock_hz, 0.0)

    def _flood(self, fault: ScenarioFault, begins: bool) -> None:
        wire = self._wires[fault.bus]
        if not begins or not isinstance(wire, Uart):
            return
        dice = random.Random(fault.begin_ns)  # noqa: S311 (a simulation)
        count = round(fault.share * wire.baud / 10 * FLOOD_NS / NS)
        for at_ns in range(fault.begin_ns + FLOOD_NS, fault.end_ns, FLOOD_NS):
            data = (fault.data * count)[:count] if fault.data else dice.randbytes(count)
            self._world.at(at_ns, partial(wire.inject, data))

    def _babble(self, fault: ScenarioFault, begins: bool) -> None:
        controller = self._controller(fault)
        if begins:
            controller.babble(fault.can_id, BABBLE, (fault.end_ns - fault.begin_ns) / NS)

    def _open_sensors(self, fault: ScenarioFault, begins: bool) -> None:
        if fault.node not in self._plants:
            raise ScenarioError(f"{self._name}: a fault names the node '{fault.node}', which has no sensor")
        page = self._plants[fault.node].page
        for name in page.names(PlantItemKind.SENSOR):
            page.set_fault(PlantItemKind.SENSOR, name, State.OPEN if begins else State.SOUND)

    def _disturb(self, fault: ScenarioFault, begins: bool) -> None:
        wire = self._wires[fault.bus]
        if isinstance(wire, CanWire):
            wire.set_bit_errors(bit_errors(fault.share) if begins else 0.0)

    def _rate(self, fault: ScenarioFault, begins: bool) -> None:
        share = fault.share if begins else 0.0
        for part in self._listeners(fault.bus):
            if fault.kind == "loss":
                part.set_faults(loss=share)
            else:
                part.set_faults(corruption=share)

    def _listeners(self, bus: str) -> list[CanController | Uart]:
        wire, port = self._wires[bus], self._ports[bus]
        if isinstance(wire, Uart) or isinstance(port, UartPort):
            return [wire] if isinstance(wire, Uart) else []
        boards = [board.node.controller for board in self._boards.values() if board.wire is wire]
        return [port.controller, *(controller for controller in boards if controller is not None)]

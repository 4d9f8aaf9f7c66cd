"""Machines whose nodes keep tables, in a simulated world: real host, links and firmware; true bit timing."""

import random
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from coordinator.simulate.script import ScriptedWorld
from nodes.bus.assign import Uuid
from nodes.bus.bus import UartBus
from nodes.bus.can_bus import CanBus
from nodes.dictionary.dictionary import Dictionary
from nodes.mt.download import DownloadTarget
from nodes.mt.mt import Pair
from nodes.mt.table import AxleTable
from nodes.node.config import NodeConfig
from nodes.node.connector import BuildConfig
from nodes.virtual._sim import lib
from nodes.virtual.world import CanWire, NodeSettings, World, WorldNode
from tests.nodes.virtual.world.machines import start_io, uuid

if TYPE_CHECKING:
    from nodes.node.node import Node

NS: Final = 1_000_000_000
LOAD_ID: Final = 0x300
LOAD_EVERY_NS: Final = 200_000
"""Two frames may wait in a controller: seldomer, and they would make less than half the bus's load."""


def wavy(points: int, seed: int = 0) -> list[Pair]:
    """Return a table as measured on a screw: POINTS ascending positions, small corrections."""
    chance = random.Random(seed)
    return [(i * 50_000, chance.randint(-40_000, 40_000)) for i in range(points)]


def _config(tables: Sequence[AxleTable]) -> BuildConfig:
    def build(dictionary: Dictionary) -> NodeConfig:
        config = NodeConfig("node", dictionary)
        for table in tables:
            table.configure(config)
        return config

    return build


class TableMachine:
    """AXLES axles spread over NODES nodes of a CAN bus, in a world of SEED."""

    def __init__(
        self,
        seed: int,
        *,
        nodes: int = 6,
        axles: int = 28,
        capacity: int = 256,
        ppm: float = 0.0,
        bitrate: int = 1_000_000,
    ) -> None:
        chance = random.Random(seed)
        self.world = ScriptedWorld(seed)
        self.wire: CanWire = self.world.add_can(bitrate=bitrate)
        self.port = self.world.add_can_port(self.wire)
        self.boards: list[WorldNode] = [
            self.world.add_node(
                self.wire,
                uuid(n),
                start_clock=(1 << 32) - 100_000_000 * n,
                move_count=256,
                settings=NodeSettings(ppm=chance.uniform(-ppm, ppm)),
            )
            for n in range(1, nodes + 1)
        ]
        self.bus = CanBus("can0", start_io(self.port))
        self.tables = [AxleTable(f"axle {k}", k, capacity) for k in range(1, axles + 1)]
        self.nodes: list[Node] = [
            self.bus.add_node(f"n{n}", Uuid.parse(uuid(n)), _config(self.tables[n - 1 :: nodes]))
            for n in range(1, nodes + 1)
        ]
        self.places = [
            DownloadTarget(table, self.nodes[index % nodes], self.bus)
            for index, table in enumerate(self.tables)
        ]

    def node(self, place: DownloadTarget) -> "Node":
        """Return the node of a place."""
        return next(node for node in self.nodes if node is place.node)

    def board(self, place: DownloadTarget) -> WorldNode:
        """Return the board of a place."""
        return self.boards[self.nodes.index(self.node(place))]

    def lose(self, share: float) -> None:
        """From now on every controller loses SHARE of what it receives, unnoticed by the sender."""
        self.port.controller.set_faults(loss=share)
        for board in self.boards:
            assert board.controller is not None
            board.controller.set_faults(loss=share)

    def burden(self, share: float) -> None:
        """Keep the bus busy for SHARE of its time with the frames of a stranger."""
        sender = self.world.add_node(self.wire, "10ad00000000").controller
        assert sender is not None
        rate = share * self.wire.bitrate
        owed_bits, number = 0.0, 0

        def send() -> None:
            nonlocal owed_bits, number
            owed_bits = min(owed_bits + rate * LOAD_EVERY_NS / NS, 4000.0)
            while owed_bits > 0:
                data = bytes((number + n) * 37 & 0xFF for n in range(8))
                if not sender.send(LOAD_ID, data):
                    break
                owed_bits -= lib.can_frame_bits(LOAD_ID, 8, data)
                number += 1
            self.world.at(self.world.now_ns + LOAD_EVERY_NS, send)

        send()

    def now_ns(self) -> int:
        """Return true time."""
        return self.world.now_ns


class UartTableMachine:
    """One node with tables on a serial line."""

    def __init__(self, seed: int, axles: int = 2, capacity: int = 256) -> None:
        self.world = World(seed)
        self.uart = self.world.add_uart()
        self.port = self.world.add_uart_port(self.uart)
        self.board = self.world.add_node(self.uart, uuid(1))
        self.bus = UartBus("uart", start_io(self.port))
        self.tables = [AxleTable(f"axle {k}", k, capacity) for k in range(1, axles + 1)]
        self.node = self.bus.add_node("n1", _config(self.tables))
        self.places = [DownloadTarget(table, self.node, None) for table in self.tables]

    def now_ns(self) -> int:
        """Return true time."""
        return self.world.now_ns

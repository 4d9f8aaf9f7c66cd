"""Whole machines in a simulated world: real CanBus and Node over real link C and real firmware."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from nodes.bus.assign import Uuid
from nodes.bus.bus import UartBus
from nodes.bus.can_bus import CanBus
from nodes.link import LinkIO
from nodes.link.interfaces import IoFactory, LinkIoInterface, OnFrame, OnLost
from nodes.node.states import NodeState
from nodes.virtual.world import CanPort, CanWire, Port, UartSettings, World, WorldNode, run
from tests.nodes.machine import make_config, stepper_x

if TYPE_CHECKING:
    from nodes.node.node import Node


def uuid(number: int) -> str:
    return f"0102030405{number:02x}"


def start_io(port: Port) -> IoFactory:
    def start(*, on_frame: OnFrame | None, on_closed: OnLost) -> LinkIoInterface:
        return LinkIO.driven_by(port.open(), on_frame=on_frame, on_closed=on_closed)

    return start


class CanMachine:
    """COUNT nodes on one bus."""

    def __init__(
        self, seed: int, count: int = 1, *, bitrate: int = 1_000_000, steppers: bool = False
    ) -> None:
        self.world = World(seed)
        self.wire: CanWire = self.world.add_can(bitrate=bitrate)
        self.port: CanPort = self.world.add_can_port(self.wire)
        self.boards: list[WorldNode] = [
            self.world.add_node(self.wire, uuid(n), start_clock=(1 << 32) - 100_000_000 * n)
            for n in range(1, count + 1)
        ]
        self.bus = CanBus("can0", start_io(self.port))
        self.steppers = [stepper_x() for _ in range(count)] if steppers else []
        configs = [make_config(stepper) for stepper in self.steppers] or [make_config()] * count
        self.nodes: list[Node] = [
            self.bus.add_node(f"n{n}", Uuid.parse(uuid(n)), config) for n, config in enumerate(configs, 1)
        ]

    def each(self, act: Callable[[WorldNode], None]) -> None:
        for board in self.boards:
            act(board)


class UartMachine:
    """One node on a serial line."""

    def __init__(self, seed: int, settings: UartSettings | None = None) -> None:
        self.world = World(seed)
        self.uart = self.world.add_uart(settings=settings)
        self.port = self.world.add_uart_port(self.uart)
        self.board = self.world.add_node(self.uart, uuid(1))
        self.bus = UartBus("uart", start_io(self.port))
        self.node = self.bus.add_node("n1", make_config())


async def ready(machine: CanMachine) -> None:
    """Start MACHINE, see all its nodes ready, and close it."""
    await machine.bus.start()
    assert [node.state for node in machine.nodes] == [NodeState.READY] * len(machine.nodes)
    await machine.bus.close()


def trace_of(seed: int) -> int:
    """Return a hash of all that happens when three nodes on a disturbed bus get ready."""
    machine = CanMachine(seed, 3)
    machine.wire.set_bit_errors(1e-5)
    run(machine.world, ready(machine), limit_s=60)
    return machine.world.trace

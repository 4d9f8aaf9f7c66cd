"""One node with devices in a simulated world: the real firmware, link and clock estimate."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Protocol

from nodes.bus.assign import Uuid
from nodes.bus.can_bus import CanBus
from nodes.dictionary.dictionary import Dictionary
from nodes.node.config import NodeConfig
from nodes.node.node import Node
from nodes.node.states import NodeState
from nodes.virtual.world import World, run
from tests.nodes.virtual.world.machines import start_io, uuid

HZ = 168_000_000


class Configured(Protocol):
    def configure(self, config: NodeConfig) -> None: ...


class Device(Configured, Protocol):
    def started(self, node: Node) -> None: ...


class DeviceMachine:
    """DEVICES on a node whose clock rolls over ROLLS_OVER_S after it has power (ready after some 2.5)."""

    def __init__(
        self, *devices: Device, rolls_over_s: float = 3.0, seed: int = 1, move_count: int = 0
    ) -> None:
        self.devices = devices
        self.world = World(seed)
        wire = self.world.add_can(bitrate=1_000_000)
        port = self.world.add_can_port(wire)
        self.board = self.world.add_node(
            wire, uuid(1), start_clock=(1 << 32) - round(rolls_over_s * HZ), move_count=move_count
        )
        self.bus = CanBus("can0", start_io(port))
        self.node = self.bus.add_node("n1", Uuid.parse(uuid(1)), self.configure, on_state=self.changed)
        self.pins: dict[str, int] = {}

    def configure(self, dictionary: Dictionary) -> NodeConfig:
        self.pins = dict(dictionary.enumerations["pin"].values)
        return self.configure_with(dictionary)

    def configure_with(self, dictionary: Dictionary) -> NodeConfig:
        config = NodeConfig("n1", dictionary)
        for device in self.devices:
            device.configure(config)
        return config

    def changed(self, node: Node) -> None:
        if node.state is NodeState.READY:
            for device in self.devices:
                device.started(node)

    def clock(self, after_s: float) -> int:
        """Return the node's clock AFTER_S from now, as the host knows it."""
        return self.node.clock.ticks_at(self.world.now_ns + round(after_s * 1e9))  # type: ignore[arg-type]

    def run(self, main: Callable[[], Awaitable[None]]) -> None:
        async def whole() -> None:
            try:
                await self.bus.start()
                await main()
            finally:
                await self.bus.close()

        run(self.world, whole())

    async def shut_down(self, limit_s: float = 60.0) -> str:
        """Wait until the node is shut down; return why."""
        async with asyncio.timeout(limit_s):
            while self.node.state is not NodeState.SHUTDOWN:  # noqa: ASYNC110  virtual time
                await asyncio.sleep(0.01)
        return str(self.node.failure)

    def edges(self, pin: str) -> list[tuple[int, int]]:
        """Return the changes of an output: the node's clock (48 bits) and the level."""
        found = self.board.edges()
        return [(int(e["clock"]), int(e["level"])) for e in found[found["pin"] == self.pins[pin]]]

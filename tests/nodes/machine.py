"""A machine of one twin node on a CAN bus, for tests of a node's life."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from nodes.bus.assign import Uuid
from nodes.bus.can_bus import CanBus
from nodes.devices.stepper import Stepper
from nodes.dictionary.dictionary import Dictionary
from nodes.node.config import NodeConfig
from nodes.node.connector import BuildConfig
from nodes.node.states import NodeState
from tests.nodes import virtual_time
from tests.nodes.twin_bus import TwinIO, TwinNode

if TYPE_CHECKING:
    from nodes.clock.clock import ClockEstimate


def uuid(number: int) -> Uuid:
    return Uuid(bytes((1, 2, 3, 4, 5, number)))


def make_config(*steppers: Stepper, init: str = "") -> BuildConfig:
    def build(dictionary: Dictionary) -> NodeConfig:
        config = NodeConfig("mainboard", dictionary)
        for stepper in steppers:
            stepper.configure(config)
        if init:
            config.add_init("fan", init)
        return config

    return build


def stepper_x(**options: Any) -> Stepper:
    return Stepper("stepper_x", step_pin="PA1", dir_pin="PB2", **options)


class Machine:
    """A CAN bus with one node named mainboard, and what it reported."""

    def __init__(self, twin: TwinNode, build: BuildConfig | None = None, **io_options: Any) -> None:
        twin.uuid = uuid(1)
        self.twin = twin
        self.io = TwinIO([twin], **io_options)
        self.bus = CanBus("can0", self.io)
        self.states: list[NodeState] = []
        self.estimates: list[ClockEstimate] = []
        self.node = self.bus.add_node(
            "mainboard",
            uuid(1),
            build or make_config(),
            on_state=lambda node: self.states.append(node.state),
            on_clock=lambda _, estimate: self.estimates.append(estimate),
        )

    def run(self, *steps: Callable[[], Awaitable[object]]) -> None:
        async def main() -> None:
            try:
                for step in steps:
                    await step()
            finally:
                await self.bus.close()
            assert all(link.closed for link in self.io.links)

        virtual_time.run(main())

    async def changed_to(self, state: NodeState) -> None:
        while self.node.state is not state:  # noqa: ASYNC110  virtual time
            await asyncio.sleep(0.01)

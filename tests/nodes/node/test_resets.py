"""Nodes on CAN that know only ``reset``: their boot loader answers for a while, not the application."""

import asyncio

import pytest

from nodes.bus.can_bus import CanBus
from nodes.node.absence import BACK_WITHIN_S
from nodes.node.errors import NodeLost
from nodes.node.states import NodeState
from nodes.support.can_protocol import SET_NODEID, SET_NODEID_BOOTLOADER
from tests.nodes import virtual_time
from tests.nodes.machine import make_config, stepper_x, uuid
from tests.nodes.twin_bus import TwinIO, TwinNode, without_commands


class BootLoader(TwinNode):
    """A node whose boot loader waits for an id for WAITS_S after a reset, then starts the application."""

    waits_s = 0.0

    def reset(self) -> None:
        super().reset()
        self.strict_id = True
        self.set_command = SET_NODEID_BOOTLOADER
        asyncio.get_running_loop().call_later(self.waits_s, self._start_application)

    def _start_application(self) -> None:
        self.nodeid, self.set_command = 0, SET_NODEID


def node_with_boot_loader(waits_s: float) -> BootLoader:
    node = BootLoader(uuid(1), source=without_commands("config_reset"), configured=True, crc=1)
    node.waits_s = waits_s
    return node


def start(node: TwinNode) -> tuple[CanBus, list[str]]:
    """Start a bus with NODE; return it, closed, and the notices."""
    said: list[str] = []
    bus = CanBus("can0", TwinIO([node]), on_notice=said.append)
    bus.add_node("mainboard", uuid(1), make_config(stepper_x()), on_state=lambda n: said.append(n.state.name))

    async def main() -> None:
        try:
            await bus.start()
        finally:
            await bus.close()

    virtual_time.run(main())
    return bus, said


@pytest.mark.parametrize("waits_s", [0.0, 0.5, 2.0, 6.0])
def test_the_application_is_waited_for(waits_s: float) -> None:
    node = node_with_boot_loader(waits_s)
    _, said = start(node)
    assert (node.nodeid, node.configured) == (4, True)
    assert node.crc != 1
    assert said.count(NodeState.READY.name) == 1
    assert NodeState.LOST.name not in said
    notices = [line for line in said if "waiting until it is back" in line]
    assert bool(notices) == (waits_s >= 1)
    for notice in notices:
        assert notice.startswith(
            "node mainboard: it was reset because it had another configuration; waiting until it is back "
            "(it is in its boot loader (Katapult) on bus can0, its firmware not started; "
        )


def test_a_board_that_stays_in_its_boot_loader_is_named_as_that() -> None:
    with pytest.raises(NodeLost) as failed:
        start(node_with_boot_loader(3 * BACK_WITHIN_S))
    assert str(failed.value) == (
        "node mainboard did not come back within 10 s: it was reset because it had another configuration, "
        "and now it is in its boot loader (Katapult) on bus can0, its firmware not started"
    )


def test_a_board_that_stays_away_is_named_as_that() -> None:
    class Dead(TwinNode):
        def reset(self) -> None:
            self.alive = False

    with pytest.raises(NodeLost) as failed:
        start(Dead(uuid(1), source=without_commands("config_reset"), configured=True, crc=1, shut_down=True))
    assert str(failed.value) == (
        "node mainboard did not come back within 10 s: it was reset because it was shut down, and now its "
        "uuid 010203040501 is not heard on bus can0"
    )

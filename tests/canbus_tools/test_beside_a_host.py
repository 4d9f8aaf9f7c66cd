"""The tools on a bus where a real host drives a node: it is not disturbed."""

import pytest

from canbus_tools.bus.talk import BusTalk, TalkError, on_bus
from canbus_tools.discovery.ask_bus import discover_nodes
from canbus_tools.discovery.inventory import DAMAGED_BLOCK, NodePresence, take_full_inventory
from canbus_tools.tools.nodes import NodesReport
from canbus_tools.tools.release_id import release
from nodes.bus.assign import AssignError
from nodes.bus.can_bus import CanBus
from nodes.node.states import NodeState
from tests.nodes.machine import make_config, stepper_x
from tests.stages.can_stage import BED, MAIN, MAIN_ID, TOOL_ID, SixNodes


def test_all_tools_that_ask_leave_a_host_its_nodes(six: SixNodes) -> None:
    stage, options = six.stage, six.stage.options

    async def use_tools() -> None:
        async with BusTalk.open(stage.computer, options) as bus:
            discovery = await discover_nodes(bus)
            assert BED in {waiting.uuid for waiting in discovery.waiting}
            found = await take_full_inventory(bus)
            states = {entry.nodeid: entry.state for entry in found.entries if entry.nodeid}
            [main] = [entry for entry in found.entries if entry.nodeid == MAIN_ID]
            assert main.facts is None
            assert main.passive is not None
            assert main.passive.firmware.mcu == "virtual-mainboard"
            assert "virtual-mainboard ?" in NodesReport(options, found).to_text()
            assert states == {MAIN_ID: NodePresence.IN_USE, TOOL_ID: NodePresence.SHUTDOWN}
            assert MAIN_ID not in found.probed
            for words in (MAIN, MAIN_ID):
                with pytest.raises((TalkError, AssignError), match="in use"):
                    await release(bus, words)

    async def drive() -> None:
        port = stage.computer.open_can(options)
        bus = CanBus("host", port.start_io)
        node = bus.add_node("main", MAIN, make_config(stepper_x()))
        await bus.start()
        try:
            assert node.state is NodeState.READY
            before = node.link.stats()
            await use_tools()
            after = node.link.stats()
            assert node.state is NodeState.READY
            assert after.blocks_sent > before.blocks_sent
            assert after.bytes_invalid == before.bytes_invalid
            assert after.timeouts == before.timeouts
        finally:
            await bus.close()
            port.close()

    on_bus(
        stage.computer, options, take_full_inventory
    )  # now the cache has the dictionaries by which traffic is explained
    with stage.user() as witness:
        stage.computer.run(drive())
    assert DAMAGED_BLOCK in witness.sent_to(TOOL_ID)
    assert DAMAGED_BLOCK not in witness.sent_to(MAIN_ID)
    assert not stage.is_shut_down(MAIN_ID)

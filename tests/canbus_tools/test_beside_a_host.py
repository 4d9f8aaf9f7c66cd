"""The tools on a bus where a real host drives a node: it is not disturbed."""

import asyncio
from contextlib import closing
from typing import Any

import pytest

from canbus_tools.node_list import list_nodes
from canbus_tools.query import query
from canbus_tools.release_id import release
from canbus_tools.survey import DAMAGED_BLOCK, State
from canbus_tools.talk import TalkError
from nodes.assign import AssignError
from nodes.can_bus import CanBus
from nodes.link import LinkIO
from nodes.node_states import NodeState
from tests.canbus_tools.other_host import Witness
from tests.canbus_tools.stage import BED, MAIN, MAIN_ID, PATIENCE_S, TOOL_ID, Stage
from tests.nodes.machine import make_config, stepper_x


def test_all_tools_that_ask_leave_a_host_its_nodes(stage: Stage) -> None:
    options = stage.place.options

    async def drive(transport: Any) -> None:
        loop = asyncio.get_running_loop()
        bus = CanBus("host", lambda **handlers: LinkIO(transport, loop, **handlers))
        node = bus.add_node("main", MAIN, make_config(stepper_x()))
        await bus.start()
        try:
            assert node.state is NodeState.READY
            before = node.link.stats()
            found = (await asyncio.to_thread(query, options)).found
            assert BED in {waiting.uuid for waiting in found.waiting}
            report = await asyncio.to_thread(list_nodes, options)
            states = {entry.nodeid: entry.state for entry in report.found.entries if entry.nodeid}
            [main] = report.found.by_nodeid(MAIN_ID)
            while main.overheard is None:  # times that a busy computer blurs make no guess
                report = await asyncio.to_thread(list_nodes, options)
                [main] = report.found.by_nodeid(MAIN_ID)
            assert main.facts is None
            assert main.overheard is not None
            assert main.overheard.firmware.mcu == "virtual-mainboard"
            assert "virtual-mainboard ?" in report.to_text()
            assert states == {MAIN_ID: State.IN_USE, TOOL_ID: State.SHUTDOWN}
            assert MAIN_ID not in report.found.probed
            for words in (MAIN, MAIN_ID):
                with pytest.raises((TalkError, AssignError), match="in use"):
                    await asyncio.to_thread(release, options, words)
            after = node.link.stats()
            assert node.state is NodeState.READY
            assert after.blocks_sent > before.blocks_sent
            assert after.bytes_invalid == before.bytes_invalid
        finally:
            await bus.close()

    async def bounded(transport: Any) -> None:
        async with asyncio.timeout(PATIENCE_S):
            await drive(transport)

    list_nodes(options)  # now the cache has the dictionaries by which traffic is explained later
    with closing(stage.place.open()) as transport, Witness(stage.place) as witness:
        asyncio.run(bounded(transport))
    assert DAMAGED_BLOCK in witness.sent_to(TOOL_ID)
    assert DAMAGED_BLOCK not in witness.sent_to(MAIN_ID)
    assert not stage.main.stop()["is_shutdown"]

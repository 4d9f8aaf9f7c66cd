"""Stop groups whose node does not say what it should."""

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest

from nodes.devices.trsync import END_S, TriggerReason, Trsync
from nodes.dictionary.message_format import Message
from nodes.node.errors import NodeError
from tests.nodes import virtual_time

REPORT_S = 0.025
ENDLESS = 1000


def node_that_is_armed_for(reports: int) -> Any:
    """Return a node that reports so often that its group has not triggered; ``asked`` counts."""
    node = SimpleNamespace(name="mcu", asked=0)

    async def query(*_: object, **__: object) -> Message:
        node.asked += 1
        assert node.asked < ENDLESS
        await asyncio.sleep(REPORT_S)
        armed = node.asked <= reports
        return Message(
            "trsync_state",
            {"oid": 3, "can_trigger": int(armed), "trigger_reason": 0 if armed else 2, "clock": 7},
        )

    node.query = query
    return node


def group() -> Trsync:
    found = Trsync("homing on node mcu")
    found.oid = 3
    return found


def test_reports_from_before_the_trigger_are_passed_over() -> None:
    """The command may be repeated for about a second before the node is lost; it reports meanwhile."""
    node = node_that_is_armed_for(50)
    state = virtual_time.run(group().finish(node))
    assert (state.armed, state.reason, node.asked) == (False, TriggerReason.HOST, 51)


def test_a_node_that_never_triggers_is_not_asked_for_ever() -> None:
    """Failed before: the homing that waited for it never ended."""
    node = node_that_is_armed_for(ENDLESS)
    with pytest.raises(
        NodeError, match="for homing on node mcu did not stop, though node mcu was sent the trigger for 3 s; "
    ):
        virtual_time.run(group().finish(node))
    assert node.asked == pytest.approx(END_S / REPORT_S, abs=1)

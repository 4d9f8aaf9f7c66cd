"""Buses that cannot start: each failure is explained, and nothing is left running."""

import asyncio
import json
import zlib

import pytest

from nodes.bus.assign import AssignError
from nodes.bus.bus import UartBus
from nodes.bus.can_bus import CanBus
from nodes.dictionary.message_format import Message
from nodes.dictionary.parts import DictionaryError
from nodes.node.errors import NodeLost
from nodes.node.states import NodeState
from tests.nodes import virtual_time
from tests.nodes.machine import Machine, make_config, stepper_x, uuid
from tests.nodes.twin_bus import TwinIO, TwinNode, source_of, without_commands

CLOCK_S = 2.0
"""A node's clock is watched for so long before it is ready."""


def test_a_missing_node_is_named_with_what_to_do_and_all_is_closed() -> None:
    machine = Machine(TwinNode(alive=False))
    with pytest.raises(
        AssignError, match="node 010203040501 not found on bus can0; nodes waiting there: none"
    ):
        machine.run(machine.bus.start)
    assert machine.io.closed
    assert machine.states[-1] is NodeState.CLOSED


def test_one_missing_node_does_not_leave_the_others_running() -> None:
    twins = [TwinNode(uuid(1)), TwinNode(uuid(9))]
    io = TwinIO(twins)
    bus = CanBus("can0", io)
    nodes = [bus.add_node(f"n{n}", uuid(n), make_config()) for n in (1, 2)]

    async def main() -> None:
        with pytest.raises(AssignError, match=r"node 010203040502 not found .*waiting there: 010203040509"):
            await bus.start()
        assert [node.state for node in nodes] == [NodeState.CLOSED] * 2
        assert all(link.closed for link in io.links)

    virtual_time.run(main())


def test_a_node_with_an_old_id_and_no_answer_to_queries_is_found_by_identify() -> None:
    machine = Machine(TwinNode(nodeid=77))

    async def check() -> None:
        assert (machine.twin.nodeid, machine.node.state) == (4, NodeState.READY)

    machine.run(machine.bus.start, check)


def test_a_node_that_takes_its_id_but_does_not_answer_on_it_is_not_called_missing() -> None:
    class Mute(TwinNode):
        def execute(self, content: bytes, now_s: float) -> list[bytes]:
            return []

    machine = Machine(Mute())
    with pytest.raises(NodeLost, match="node 010203040501 on bus can0 took id 4 but does not answer on it"):
        machine.run(machine.bus.start)


def test_a_silent_uart_is_explained() -> None:
    bus = UartBus("/dev/ttyS9", TwinIO([TwinNode(alive=False)]))
    bus.add_node("mainboard", make_config())

    async def main() -> None:
        with pytest.raises(
            NodeLost, match="no answer on /dev/ttyS9; check its wiring and power, the baud rate"
        ):
            await bus.start()

    virtual_time.run(main())


def test_start_cancelled_at_any_moment_closes_everything() -> None:
    async def main() -> None:
        moment_s = 0.0
        while True:
            io = TwinIO([TwinNode(uuid(1))])
            bus = CanBus("can0", io)
            node = bus.add_node("mainboard", uuid(1), make_config(stepper_x()))
            starting = asyncio.ensure_future(bus.start())
            await asyncio.sleep(moment_s)
            if starting.done():
                assert moment_s > CLOCK_S
                await bus.close()
                return
            starting.cancel()
            await asyncio.wait([starting])
            assert starting.cancelled()
            assert node.state is NodeState.CLOSED
            assert io.closed
            assert all(link.closed for link in io.links)
            # Towards the end its clock is watched, and nothing else.
            moment_s += 0.013 if moment_s < 0.3 else 0.21

    virtual_time.run(main())


@pytest.mark.parametrize(
    ("twin", "sentence"),
    [
        (TwinNode(compressed=b"garbage" * 9), "node mainboard: dictionary: not zlib data"),
        (TwinNode(source=without_commands("get_uptime")), "firmware 'vectors-1' has no command 'get_uptime'"),
        (
            TwinNode(compressed=zlib.compress(json.dumps(source_of(config={"CLOCK_FREQ": 0})).encode())),
            "constant CLOCK_FREQ must be",
        ),
    ],
)
def test_a_dictionary_that_cannot_be_used_is_refused_in_a_sentence(twin: TwinNode, sentence: str) -> None:
    machine = Machine(twin)
    with pytest.raises(DictionaryError, match=sentence):
        machine.run(machine.bus.start)


def test_a_dictionary_without_end_is_refused() -> None:
    class Endless(TwinNode):
        def _answer(self, message: Message, now_s: float) -> list[bytes]:
            if message.name == "identify":
                return [self.response("identify_response", offset=message.integer("offset"), data=bytes(50))]
            return super()._answer(message, now_s)

    machine = Machine(Endless())
    with pytest.raises(DictionaryError, match="does not end"):
        machine.run(machine.bus.start)

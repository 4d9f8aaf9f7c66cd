"""Talking with a node that is ready: queries, listeners, clocks of commands."""

import asyncio

import pytest

from nodes.dictionary.message_format import Message, MessageError
from nodes.node.load import load_of
from nodes.node.request_reply import QueryTimeout
from tests.nodes.machine import Machine
from tests.nodes.twin_bus import TwinNode


def test_queries_match_their_oid() -> None:
    machine = Machine(TwinNode())

    async def check() -> None:
        names = ("stepper_get_position", "stepper_position")
        answers = await asyncio.gather(*(machine.node.query(*names, oid=oid) for oid in (3, 1, 2)))
        assert [answer.integer("pos") for answer in answers] == [-300, -100, -200]

    machine.run(machine.bus.start, check)


def test_a_query_without_an_answer_and_one_that_is_not_there() -> None:
    machine = Machine(TwinNode())

    async def check() -> None:
        machine.twin.alive = False
        with pytest.raises(QueryTimeout, match=r"mainboard did not answer debug_ping within 0.5 s"):
            await machine.node.query("debug_ping", "pong", data=b"x", tries=2)
        with pytest.raises(MessageError, match=r"node mainboard: .*no command 'fly'"):
            await machine.node.query("fly", "flown")
        with pytest.raises(MessageError, match="no response 'flown'"):
            await machine.node.query("debug_ping", "flown", data=b"")

    machine.run(machine.bus.start, check)


def test_listeners_stats_and_garbage() -> None:
    machine = Machine(TwinNode())
    heard: list[str] = []

    async def check() -> None:
        end = machine.node.on("stepper_position", 1, lambda message: heard.append(str(message)))
        machine.node.on("stepper_position", None, lambda message: heard.append("any " + str(message)))
        say, response = machine.io.links[0].say, machine.twin.response
        say(response("stepper_position", oid=1, pos=5))
        say(response("stepper_position", oid=2, pos=6))
        say(response("stats", count=100, sum=50_000, sumsq=100_000))
        say(b"\x9f\x9f\x9f")
        await asyncio.sleep(0.01)
        end()
        say(response("stepper_position", oid=1, pos=7))
        await asyncio.sleep(0.01)
        assert machine.node.undecodable == 1
        assert machine.node.load is not None
        assert machine.node.load.awake == pytest.approx(0.01)

    machine.run(machine.bus.start, check)
    assert heard == [
        "stepper_position oid=1 pos=5",
        "any stepper_position oid=1 pos=5",
        "any stepper_position oid=2 pos=6",
        "any stepper_position oid=1 pos=7",
    ]


def test_load_from_stats() -> None:
    # 4 rounds of 100, 100, 300, 300 ticks at 1 MHz: mean 200 µs, deviation 100 µs.
    stats = Message("stats", {"count": 4, "sum": 800, "sumsq": 200_000})
    load = load_of(stats, 1_000_000, 1)
    assert (load.task_s, load.task_spread_s) == pytest.approx((200e-6, 100e-6))
    assert load_of(Message("stats", {"count": 0, "sum": 0, "sumsq": 0}), 1, 1).awake == 0


def test_commands_carry_their_clocks_to_the_link() -> None:
    machine = Machine(TwinNode())

    async def check() -> None:
        machine.node.send("queue_step", min_clock=5, req_clock=9, oid=0, interval=1, count=1, add=0)
        content, min_clock, req_clock = machine.io.links[0].sent[-1]
        assert (min_clock, req_clock) == (5, 9)
        assert machine.node.dictionary.decode_commands(content) is not None

    machine.run(machine.bus.start, check)

"""Talking to one node from a tool."""

import asyncio
from collections.abc import Callable, Coroutine
from itertools import pairwise
from typing import Any

import pytest

from canbus_tools.bus.talk import LISTEN_S, BusTalk, TalkError
from canbus_tools.protocol.frame import Frame
from nodes.dictionary.cache import DictionaryCache
from nodes.dictionary.message_format import Message
from tests.stages.can_stage import MAIN, MAIN_ID, TOOL_ID, CanStage, SixNodes

OTHER_ID = 200
PAUSE_S = 0.001
"""Frames of one exchange follow each other faster."""


def run(stage: CanStage, test: Callable[[], Coroutine[Any, Any, None]]) -> None:
    stage.computer.run(test())


def test_a_node_is_asked_and_told_things_and_everything_it_says_is_seen(six: SixNodes) -> None:
    stage = six.stage

    async def talk() -> None:
        async with stage.talk(MAIN_ID) as node:
            assert node.dictionary.str_constant("MCU") == "virtual-mainboard"
            before = node.stats
            answer = await node.ask("get_canbus_id", "canbus_id")
            assert answer.message.data("canbus_uuid") == MAIN.raw
            assert 0 < answer.sent_ns < answer.received_ns
            seen: list[Message] = []
            came = asyncio.Event()

            def note(message: Message, received_ns: int) -> None:
                assert received_ns > answer.received_ns
                if message.name == "pong":
                    seen.append(message)
                    came.set()

            end = node.on_message(note)
            node.send("debug_ping", {"data": b"hello"})
            await came.wait()
            assert [message.data("data") for message in seen] == [b"hello"]
            end()
            assert node.knows("get_canbus_status", "canbus_status")
            assert not node.knows("get_canbus_status", "nonsense")
            await node.drained()
            assert (node.stats.bytes_invalid, node.stats.timeouts) == (before.bytes_invalid, before.timeouts)

    run(stage, talk)
    run(stage, talk)  # a node that was talked to before expects another block number


def test_a_node_in_shutdown_still_answers(six: SixNodes) -> None:
    assert six.stage.ask(TOOL_ID, "get_config", "config").integer("is_shutdown") == 1


def test_nobody_there_is_one_sentence(stage: CanStage) -> None:
    with pytest.raises(TalkError, match=r"no node answers on id 77 of bus .*canductor can nodes"):
        stage.ask(77, "get_uptime", "uptime")


def test_a_node_that_another_host_uses_is_left_alone_unless_forced(six: SixNodes) -> None:
    with six.stage.other_host(MAIN_ID, every_s=0.98):  # as often as hosts ask for clocks
        began_ns = six.stage.world.now_ns
        with pytest.raises(TalkError, match=f"node {MAIN_ID} on bus .* is in use: another program"):
            six.stage.ask(MAIN_ID, "get_uptime", "uptime")
        assert six.stage.world.now_ns - began_ns < LISTEN_S * 1e9
        six.stage.ask(MAIN_ID, "get_uptime", "uptime", force=True)


def read_dictionary(stage: CanStage, *, other_host: bool) -> list[Frame]:
    """Read a node's dictionary, and return the frames of that."""

    async def read() -> None:
        async with BusTalk.open(stage.computer, stage.options, DictionaryCache()) as bus:
            assert await bus.has_host(OTHER_ID) == other_host
            async with bus.node(MAIN_ID):
                pass

    with stage.computer.listen(stage.options) as listener:
        stage.computer.run(read())
        return [frame for frame in listener.take() if frame.can_id in (0x108, 0x109)]


def test_beside_a_host_a_dictionary_is_read_with_pauses(six: SixNodes) -> None:
    """After each question the bus is left to others for four times as long as the question took."""
    alone = read_dictionary(six.stage, other_host=False)
    with six.stage.other_host(OTHER_ID):
        beside = read_dictionary(six.stage, other_host=True)
    assert len(exchanges(alone)) < 5
    found = exchanges(beside)
    assert len(found) > 50
    for exchange, following in pairwise(found[1:-1]):  # the first contact is no question
        answered = [frame for frame in exchange if frame.data[:1] != b"\x05"]  # not by a lone acknowledgement
        took_s = answered[-1].time_s - exchange[0].time_s
        assert following[0].time_s - exchange[-1].time_s > 3.9 * took_s


def exchanges(frames: list[Frame]) -> list[list[Frame]]:
    """Return the frames of each question with its answer."""
    found = [[frames[0]]]
    for frame in frames[1:]:
        if frame.time_s - found[-1][-1].time_s > PAUSE_S:
            found.append([])
        found[-1].append(frame)
    return found

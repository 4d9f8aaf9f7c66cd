"""Talking to one node from a tool."""

import asyncio
import dataclasses
import time
from collections.abc import Callable, Coroutine
from itertools import pairwise
from typing import Any

import can
import pytest

from canbus_tools.open_bus import BusOptions
from canbus_tools.talk import BusTalk, NodeTalk, TalkError
from nodes.conversation import Answer, Conversation
from nodes.dictionary_cache import DictionaryCache
from nodes.message_format import Message
from tests.canbus_tools.other_host import OtherHost
from tests.canbus_tools.stage import MAIN, MAIN_ID, PATIENCE_S, TOOL_ID, Place, Stage

QUIET_S = 0.05
"""Nobody else is on these buses."""
OTHER_ID = 200


def run(test: Callable[[], Coroutine[Any, Any, None]]) -> None:
    async def bounded() -> None:
        async with asyncio.timeout(PATIENCE_S):
            await test()

    asyncio.run(bounded())


def test_a_node_is_asked_and_told_things_and_everything_it_says_is_seen(stage: Stage) -> None:
    async def talk() -> None:
        async with NodeTalk.open(stage.place.options, MAIN_ID, listen_s=QUIET_S) as node:
            assert node.dictionary.str_constant("MCU") == "virtual-mainboard"
            before = node.stats
            answer = await node.ask("get_canbus_id", "canbus_id")
            assert answer.message.data("canbus_uuid") == MAIN.raw
            assert answer.sent_ns < answer.received_ns  # 0 if it had to be asked again
            seen: list[Message] = []
            came = asyncio.Event()

            def note(message: Message, received_ns: int) -> None:
                assert received_ns > answer.received_ns
                if message.name == "pong":
                    seen.append(message)
                    came.set()

            end = node.on_message(note)
            node.send_text('debug_ping data="hello"')
            await came.wait()
            assert [message.data("data") for message in seen] == [b"hello"]
            end()
            assert node.knows("get_canbus_status", "canbus_status")
            assert not node.knows("get_canbus_status", "nonsense")
            await node.drained()
            assert node.stats.bytes_invalid == before.bytes_invalid  # half a block may have been late before

    run(talk)
    run(talk)  # a node that was talked to before expects another block number


def test_a_node_in_shutdown_still_answers(stage: Stage) -> None:
    async def talk() -> None:
        async with NodeTalk.open(stage.place.options, TOOL_ID, listen_s=QUIET_S) as node:
            assert (await node.ask("get_config", "config")).message.integer("is_shutdown") == 1

    run(talk)


def test_nobody_there_is_one_sentence(place: Place) -> None:
    async def talk() -> None:
        async with NodeTalk.open(place.options, 77, listen_s=QUIET_S):
            raise AssertionError("there is no node 77")

    with pytest.raises(TalkError, match=r"no node answers on id 77 of bus .*canductor can nodes"):
        run(talk)


def test_a_node_that_another_host_uses_is_left_alone_unless_forced(stage: Stage) -> None:
    async def talk(*, force: bool) -> None:
        async with NodeTalk.open(stage.place.options, MAIN_ID, force=force) as node:
            await node.ask("get_uptime", "uptime")

    with OtherHost(stage.place, MAIN_ID):
        with pytest.raises(TalkError, match=f"node {MAIN_ID} on bus .* is in use: another program"):
            run(lambda: talk(force=False))
        run(lambda: talk(force=True))


def test_any_backend_of_python_can_serves(stage: Stage) -> None:
    """Its own virtual bus, on which the stage is heard through two forwarders."""
    options = BusOptions(interface="virtual", channel="forwarded stage")

    async def talk() -> None:
        async with NodeTalk.open(options, MAIN_ID, listen_s=QUIET_S) as node:
            answer = await node.ask("get_canbus_id", "canbus_id")
            assert answer.message.data("canbus_uuid") == MAIN.raw

    with can.Bus(**dataclasses.asdict(stage.place)) as here, can.Bus("forwarded stage", "virtual") as there:
        forwarders = [can.Notifier(here, [there.send], 0.05), can.Notifier(there, [here.send], 0.05)]
        try:
            run(talk)
        finally:
            for forwarder in forwarders:
                forwarder.stop()


def test_beside_a_host_a_dictionary_is_read_with_pauses(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After each question the bus is left to others for four times as long as the question took."""
    ask = Conversation.ask
    asked: list[tuple[float, float]] = []

    async def timed(self: Conversation, *args: Any, **kwargs: Any) -> Answer:
        began_s = time.monotonic()
        answer = await ask(self, *args, **kwargs)
        asked.append((began_s, time.monotonic()))
        return answer

    async def read_dictionary(*, beside: bool) -> list[bool]:
        asked.clear()
        async with BusTalk.open(stage.place.options, DictionaryCache()) as bus:
            assert await bus.has_host(OTHER_ID, PATIENCE_S if beside else QUIET_S) == beside
            async with bus.node(MAIN_ID):
                return [
                    following_s - end_s > 3.9 * (end_s - began_s)
                    for (began_s, end_s), (following_s, _) in pairwise(asked)
                ]

    monkeypatch.setattr(Conversation, "ask", timed)
    alone = asyncio.run(read_dictionary(beside=False))
    assert len(alone) > 20
    assert not all(alone)
    with OtherHost(stage.place, OTHER_ID):
        assert all(asyncio.run(read_dictionary(beside=True)))

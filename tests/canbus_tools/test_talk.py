"""Talking to one node from a tool."""

import asyncio
import dataclasses
import time
from collections.abc import Callable, Coroutine
from typing import Any

import can
import pytest

from canbus_tools.open_bus import BusOptions
from canbus_tools.talk import BusTalk, NodeTalk, TalkError
from nodes.dictionary_cache import DictionaryCache
from nodes.message_format import Message
from tests.canbus_tools.other_host import OtherHost
from tests.canbus_tools.stage import MAIN, MAIN_ID, PATIENCE_S, TOOL_ID, Place, Stage

QUIET_S = 0.05
"""Nobody else is on these buses."""


def run(test: Callable[[], Coroutine[Any, Any, None]]) -> None:
    async def bounded() -> None:
        async with asyncio.timeout(PATIENCE_S):
            await test()

    asyncio.run(bounded())


def test_a_node_is_asked_and_told_things_and_everything_it_says_is_seen(stage: Stage) -> None:
    async def talk() -> None:
        async with NodeTalk.open(stage.place.options, MAIN_ID, listen_s=QUIET_S) as node:
            assert node.dictionary.str_constant("MCU") == "virtual-mainboard"
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
            assert node.stats.bytes_invalid == 0

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


def test_beside_a_host_a_dictionary_is_read_with_pauses(stage: Stage) -> None:
    async def read_dictionary_s() -> float:
        async with BusTalk.open(stage.place.options, DictionaryCache()) as bus:
            assert not await bus.has_host(MAIN_ID, QUIET_S)
            began_s = time.monotonic()
            async with bus.node(MAIN_ID):
                return time.monotonic() - began_s

    alone_s = min(asyncio.run(read_dictionary_s()) for _ in range(3))  # the machine may be busy
    with OtherHost(stage.place, 200):
        beside_s = asyncio.run(read_dictionary_s())
    assert beside_s > 2.5 * alone_s  # 5 times, less what does not depend on it: opening, first contact

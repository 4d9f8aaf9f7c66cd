"""Asking coordinators over their sockets: what answers there may be anything, and nothing of it disturbs."""

import asyncio
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from canbus_tools.bus.open_bus import BusOptions
from canbus_tools.discovery import ask_host
from canbus_tools.discovery.ask_host import ask_hosts
from canbus_tools.discovery.node_info import NodeInfo
from tests.stages.own_sockets import own_sockets

NODE = {
    "bus": "can0",
    "nodeid": 4,
    "uuid": "90a4ae022dfc",
    "state": "shutdown",
    "mcu": "stm32g0b1xx",
    "firmware": "canductor",
    "firmware_version": "v1",
    "clock_freq_hz": 64_000_000,
}
Ask = Callable[[bytes | None], dict[int, NodeInfo]]


@pytest.fixture
def ask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Ask:
    """Ask a program that says what is given after the first line it gets; None: it never says a word."""
    own_sockets(monkeypatch, tmp_path)

    def asked(says: bytes | None) -> dict[int, NodeInfo]:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.readline()
            if says is None:
                await reader.read()  # until the asker leaves
            else:
                writer.write(says)
            writer.close()

        async def main() -> dict[int, NodeInfo]:
            path = tmp_path / "canductor" / "one.sock"
            async with await asyncio.start_unix_server(serve, path):
                timeout_s = ask_host.TIMEOUT_S if says is not None else 0.02
                return await ask_hosts(BusOptions(interface="socketcan", channel="can0"), timeout_s)

        return asyncio.run(main())

    return asked


def answer(*nodes: object) -> bytes:
    return b'{"id":1,"result":{}}\n' + json.dumps({"id": 2, "result": {"nodes": nodes}}).encode() + b"\n"


def test_what_a_coordinator_says_of_its_nodes_on_this_bus(ask: Ask) -> None:
    told = ask(answer(NODE, NODE | {"bus": "can1", "nodeid": 5}, NODE | {"bus": "tty", "nodeid": None}))
    assert told.keys() == {4}
    assert (str(told[4].uuid), told[4].firmware.mcu, told[4].shut_down) == (
        "90a4ae022dfc",
        "stm32g0b1xx",
        True,
    )


@pytest.mark.parametrize(
    "says",
    [
        b"",
        b"\xff\x00 no JSON\n",
        b"[1, 2]\n",
        b'{"id": 2, "error": {"code": "not_ready"}}\n',
        b'{"id": 2, "result": {"nodes": 7}}\n',
        b"[" * 500_000 + b"\n",
        b'"' + b"x" * (ask_host.LINE_MAX + 1),
        answer(1, "two", None, [], NODE | {"nodeid": "4"}),
    ],
    ids=["end", "garbage", "list", "error", "number", "nested", "long", "strange"],
)
def test_no_sense_is_nobody(ask: Ask, says: bytes) -> None:
    assert ask(says) == {}


def test_strange_values_are_left_out(ask: Ask) -> None:
    told = ask(answer(NODE | {"uuid": "no uuid", "clock_freq_hz": "fast", "mcu": None}))
    assert (told[4].uuid, told[4].firmware.clock_hz, told[4].firmware.mcu) == (None, None, "")


def test_who_says_nothing_is_not_waited_for(ask: Ask) -> None:
    assert ask(None) == {}

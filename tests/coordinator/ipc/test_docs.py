"""The examples of docs/ipc.md, byte for byte."""

import asyncio
import re
from pathlib import Path

import msgpack

from coordinator.ipc.settings import IpcSettings, Limits
from coordinator.ipc.wire import Encoder, Encoding, WireReader
from tests.coordinator.ipc.served import Served, serving

DOC = (Path(__file__).parents[3] / "docs" / "ipc.md").read_text()


def blocks(kind: str) -> list[str]:
    return re.findall(rf"^```{kind}\n(.*?)^```", DOC, re.MULTILINE | re.DOTALL)


def test_the_bytes() -> None:
    (text,) = blocks("bytes")
    stream = bytes.fromhex(text.replace(">", ""))
    reader = WireReader(Limits())
    reader.feed(stream, 0.0)
    messages = []
    while isinstance(message := reader.next_message(), dict):
        messages.append(message)
    assert messages == [
        {"id": 1, "method": "api.hello", "params": {"version": 1}},
        {"id": 2, "method": "api.ping"},
    ]
    assert reader.waiting_bytes == 0
    assert b"".join(Encoder().message(Encoding.MSGPACK, message) for message in messages) == stream
    assert msgpack.unpackb(stream[4 : 4 + stream[3]]) == messages[0]


def test_the_lines(tmp_path: Path) -> None:
    """A server in the state that the examples suppose says exactly this."""
    talk, update = (block.splitlines() for block in blocks("json-lines"))

    async def body(served: Served) -> None:
        for _ in range(5):
            served.state.set("nodes.a.state", served.state.sequence)
        served.state.set("nodes.a.state", "ready")
        served.state.set("nodes.a.load", 0.25)
        reader, writer = await served.dial()
        for line in talk:
            if line.startswith("> "):
                writer.write(line[2:].encode() + b"\n")
            else:
                assert (await reader.readline()).decode() == line[2:] + "\n"
        served.state.set("nodes.a.load", 0.5)
        assert (await reader.readline()).decode() == update[0][2:] + "\n"

    async def main() -> None:
        async with asyncio.timeout(20), serving(tmp_path) as served:
            await body(served)

    asyncio.run(main())


def test_the_limits() -> None:
    limits, settings = Limits(), IpcSettings(unix_path=None)
    for words in (
        f"{limits.message_bytes:,} bytes a message",
        f"{limits.nesting} lists and maps inside one another",
        f"{limits.items:,} entries in one",
        f"{limits.message_timeout_s:g} s for a message",
        f"{limits.running_requests} requests running and {limits.pending_requests} waiting",
        f"{limits.subscriptions} subscriptions of up to {limits.filters} globs",
        f"{settings.connections_max} connections",
        f"(0.01 to {limits.rate_hz_max:g})",
        f"At most {limits.notifications} wait",
        f"{limits.output_bytes_max >> 20} MiB of answers",
    ):
        assert words in " ".join(DOC.split()), words

"""The examples of docs/ipc.md, byte for byte."""

import ast
import re
from pathlib import Path

import msgpack

from coordinator.ipc.protocol.limits import Limits
from coordinator.ipc.protocol.messages import Encoder, Encoding, WireReader
from coordinator.ipc.server.session_methods import RATE_HZ_MAX, RATE_HZ_MIN
from coordinator.ipc.server.settings import IpcSettings
from tests.coordinator.ipc.served import Served, serving
from tests.stages import jump_loop

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
        async with serving(tmp_path) as served:
            await body(served)

    jump_loop.run(main())


def codes_of(path: Path) -> set[str]:
    """Return the codes of the errors that a file of the source makes."""
    found: set[str] = set()
    for call in ast.walk(ast.parse(path.read_text())):
        if isinstance(call, ast.Call) and ast.unparse(call.func) in (
            "ApiError",
            "EndReason",
            "RejectedError",
            "super().__init__",
        ):
            parts = (part for first in call.args[:1] for part in ast.walk(first))
            words = (part.value for part in parts if isinstance(part, ast.Constant))
            found |= {word for word in words if isinstance(word, str) and re.fullmatch("[a-z_]+", word)}
    return found


def test_the_codes_are_those_of_the_program() -> None:
    """Each code in the source is in a table, and none is there that the source does not know."""
    folder = Path(__file__).parents[3] / "coordinator"
    paths = [path for path in folder.rglob("*.py") if "coordinator.ipc." in path.read_text()]
    known = set().union(*map(codes_of, paths)) - {"code"}  # which a client reads out of an answer
    section = DOC[DOC.index("## Errors") : DOC.index("## Watching")]
    told = {
        code
        for row in re.findall(r"^\| (`.*?) \|", section, re.MULTILINE)
        for code in re.findall(r"`([a-z_]+)`", row)
    }
    assert {"bad_gcode", "file_exists", "no_job", "bad_move", "bad_params", "too_many_failures"} <= known
    assert told == known


def test_a_field_of_the_state_is_told_once() -> None:
    doc = (Path(__file__).parents[3] / "docs" / "run.md").read_text()
    section = doc[doc.index("## State") : doc.index("Lines of the log come")]
    fields = [
        (words[0] if "." not in words[0] else words[0].rpartition(".")[0], word.strip().rpartition(".")[2])
        for row in re.findall(r"^\| ([a-z]+\..*?) \|", section, re.MULTILINE)
        for words in [row.split(", ")]
        for word in words
    ]
    assert len(fields) > 40
    assert [field for field in fields if fields.count(field) > 1] == []
    assert ("modules.NAME", "*") in fields


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
        f"({RATE_HZ_MIN:g} to {RATE_HZ_MAX:g})",
        f"At most {limits.notifications} wait",
        f"{limits.output_bytes_max >> 20} MiB of answers",
    ):
        assert words in " ".join(DOC.split()), words

"""Sessions as recorded: everything decodes, and encodes again to the same bytes."""

import json
import struct
from pathlib import Path

import pytest

from nodes.dictionary.dictionary import BOOTSTRAP, Dictionary
from nodes.dictionary.message_format import Message
from tests import wire_twin as twin
from tests.nodes.dictionary.as_sent import decode_as_sent, encode_as_sent

ROOT = Path(__file__).parents[3]
DATA = ROOT / "tests" / "data"
SHARED = ROOT / ".." / "shared" / "data"
RECORD = struct.Struct("<dBI")
HOST_TO_NODE, NODE_TO_HOST = 0, 1


def test_golden_session() -> None:
    dictionary = Dictionary.from_json((DATA / "dictionary.json").read_bytes())
    golden = json.loads((DATA / "session.json").read_text())
    for entry in golden["session"]:
        [block], losses, rest = twin.blocks(bytes.fromhex(entry["block"]))
        assert (losses, rest) == (0, b"")
        command = dictionary.command(entry["name"])
        values = [bytes.fromhex(v) if isinstance(v, str) else v for v in entry["values"]]
        assert command.encode(dict(zip(command.names, values, strict=True))) == block.content
        decoded = decode_as_sent(dictionary, block.content)
        assert decoded is not None
        assert encode_as_sent(dictionary, decoded) == block.content


def test_long_forms_mean_the_same_and_are_told_apart() -> None:
    dictionary = Dictionary.from_json((DATA / "dictionary.json").read_bytes())
    content = bytes.fromhex(json.loads((DATA / "session.json").read_text())["long_forms"])
    assert dictionary.decode_commands(content) == [
        Message("set_digital_out", {"pin": 160032704, "value": 1}),
        Message("finalize_config", {"crc": 0xFFFFFFFF}),
    ]
    exact = decode_as_sent(dictionary, content)
    assert exact is not None
    assert [m.params for m in exact] == [{"pin": (1 << 32) + 160032704, "value": 1}, {"crc": 0xFFFFFFFF}]
    assert encode_as_sent(dictionary, exact) == content


@pytest.fixture(scope="module")
def recorded() -> tuple[bytes, bytes, Dictionary]:
    path = SHARED / "wire" / "pipe.rec"
    if not path.exists():
        pytest.skip("no recorded session of a real node in ../shared")
    streams = [bytearray(), bytearray()]
    record, at = path.read_bytes(), 0
    while at < len(record):
        _, direction, size = RECORD.unpack_from(record, at)
        at += RECORD.size
        streams[direction] += record[at : at + size]
        at += size
    dictionary = Dictionary.from_json((SHARED / "dictionaries" / "linuxprocess.json").read_bytes())
    return bytes(streams[HOST_TO_NODE]), bytes(streams[NODE_TO_HOST]), dictionary


def test_commands_of_the_recorded_session(recorded: tuple[bytes, bytes, Dictionary]) -> None:
    stream, _, dictionary = recorded
    found, losses, rest = twin.blocks(stream)
    assert (losses, rest) == (0, b"")
    again = b""
    commands = 0
    for block in found:
        messages = decode_as_sent(dictionary, block.content)
        assert messages is not None, block
        commands += len(messages)
        again += twin.block(block.sequence, encode_as_sent(dictionary, messages))
        # A node reads 32 bits of every number; so does the everyday decoder.
        everyday = dictionary.decode_commands(block.content)
        assert everyday is not None
        for exact, plain in zip(messages, everyday, strict=True):
            assert dictionary.decode_commands(dictionary.encode_text(str(plain))) == [plain]
            for name, value in exact.params.items():
                if isinstance(value, int):
                    assert (value - plain.integer(name)) % 256 == 0
    assert again == stream
    assert commands > 300


def test_responses_of_the_recorded_session(recorded: tuple[bytes, bytes, Dictionary]) -> None:
    _, stream, dictionary = recorded
    found, losses, rest = twin.blocks(stream)
    assert (losses, rest) == (0, b"")
    again = b""
    for block in found:
        content = block.content
        if content:
            message = dictionary.decode(content)
            assert message is not None, block
            content = dictionary.responses[message.name].encode(message.params)
        again += twin.block(block.sequence, content)
    assert again == stream


def test_the_dictionary_downloaded_in_the_recorded_session(recorded: tuple[bytes, bytes, Dictionary]) -> None:
    _, stream, dictionary = recorded
    pieces: dict[int, bytes] = {}
    for block in twin.blocks(stream)[0]:
        message = BOOTSTRAP.decode(block.content)
        if message is not None:
            pieces[message.integer("offset")] = message.data("data")
    data = b"".join(pieces[offset] for offset in sorted(pieces))
    downloaded = Dictionary.parse(data)
    assert {f.text for f in downloaded.commands.values()} == {f.text for f in dictionary.commands.values()}
    assert downloaded.constants == dictionary.constants

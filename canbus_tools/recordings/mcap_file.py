"""MCAP files, which Foxglove Studio opens: frames, decoded messages and counters, as channels of JSON.

Times are those of the frames. The writer buffers one chunk (1 MB) and an index entry per chunk.
"""

import json
from collections.abc import Iterator, Mapping
from typing import Any, BinaryIO, Final

from mcap.exceptions import McapError
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from canbus_tools.protocol.decoded import Decoded
from canbus_tools.protocol.frame import Frame, FrameKind
from nodes.support.errors import CanductorError

FRAMES: Final = "/can/frames"
MESSAGES: Final = "/can/messages"
COUNTERS: Final = "/can/counters"
MAGIC: Final = b"\x89MCAP0\r\n"
RECORD_MAX: Final = 64 << 20
"""Bytes of one record in a file that is read; chunks are usually 1 to 4 MB."""
_NS: Final = 1_000_000_000
_TIME_END_S: Final = 1 << 33


def _schema(title: str, properties: Mapping[str, object]) -> bytes:
    return json.dumps({"title": title, "type": "object", "properties": properties}).encode()


def _described(kind: str, description: str) -> dict[str, str]:
    return {"type": kind, "description": description}


FRAME_SCHEMA: Final = _schema(
    "canductor.Frame",
    {
        "bus": _described("string", "the interface"),
        "id": _described("integer", "CAN id"),
        "kind": {"type": "string", "enum": [kind.name.lower() for kind in FrameKind]},
        "size": _described("integer", "bytes of data"),
        "data": _described("string", "hex digits"),
    },
)
MESSAGE_SCHEMA: Final = _schema(
    "canductor.Message",
    {
        "bus": _described("string", "the interface"),
        "nodeid": _described("integer", "-1: not about one node"),
        "direction": {"type": "string", "enum": ["to", "from", "any"]},
        "kind": _described("string", "message, ack, nak, admin, signal, noise, error, other"),
        "name": _described("string", "of the message"),
        "seq": _described("integer", "number of its block modulo 16; -1: no block"),
        "repeated": _described("boolean", "the block was sent before"),
        "params": _described("object", "parameters by name; buffers as hex digits"),
        "text": _described("string", "all of it as a line"),
    },
)
COUNTERS_SCHEMA: Final = _schema(
    "canductor.Counters",
    {
        "frames": _described("integer", "since the recording began"),
        "bytes": _described("integer", "of data, since the recording began"),
        "nodes": {"type": "array", "items": {"type": "object"}},
    },
)


class McapWriter:
    """Writes one recording to FILE, which stays open; raises OSError of the file."""

    def __init__(self, file: BinaryIO) -> None:
        self._writer = Writer(file)
        self._writer.start(profile="", library="canductor")
        self._channels = {
            topic: self._channel(topic, name, schema)
            for topic, name, schema in (
                (FRAMES, "canductor.Frame", FRAME_SCHEMA),
                (MESSAGES, "canductor.Message", MESSAGE_SCHEMA),
                (COUNTERS, "canductor.Counters", COUNTERS_SCHEMA),
            )
        }

    def _channel(self, topic: str, name: str, schema: bytes) -> int:
        schema_id = self._writer.register_schema(name=name, encoding="jsonschema", data=schema)
        return self._writer.register_channel(topic=topic, message_encoding="json", schema_id=schema_id)

    def frame(self, frame: Frame) -> None:
        """Add a frame."""
        values = {
            "bus": frame.channel,
            "id": frame.can_id,
            "kind": frame.kind.name.lower(),
            "size": len(frame.data),
            "data": frame.data.hex(),
        }
        self._add(FRAMES, frame.time_s, values)

    def said(self, said: Decoded) -> None:
        """Add a decoded message."""
        self._add(MESSAGES, said.time_s, {"nodeid": -1, **json_of(said)})

    def counters(self, time_s: float, values: Mapping[str, object]) -> None:
        """Add the current counters."""
        self._add(COUNTERS, time_s, values)

    def finish(self) -> None:
        """Write the last chunk and the index."""
        self._writer.finish()  # type: ignore[no-untyped-call]

    def _add(self, topic: str, time_s: float, values: Mapping[str, object]) -> None:
        at_ns = nanoseconds(time_s)
        data = json.dumps(values, separators=(",", ":")).encode()
        self._writer.add_message(self._channels[topic], log_time=at_ns, publish_time=at_ns, data=data)


def nanoseconds(time_s: float) -> int:
    """Return a frame's time for MCAP; 0 for times out of its range."""
    if not 0 <= time_s < _TIME_END_S:
        return 0
    whole_s = int(time_s)
    return whole_s * _NS + round((time_s - whole_s) * _NS)  # a float of ns is not exact


def json_of(said: Decoded) -> dict[str, Any]:
    """Return a decoded message as JSON values; without ``nodeid`` if it is not about one node."""
    values: dict[str, Any] = {"bus": said.channel}
    if said.nodeid is not None:
        values["nodeid"] = said.nodeid
    return values | {
        "direction": said.direction.value,
        "kind": said.kind.value,
        "name": said.name,
        "seq": said.seq,
        "repeated": said.repeated,
        "params": {k: v.hex() if isinstance(v, bytes) else v for k, v in said.params.items()},
        "text": said.text,
    }


def json_line(said: Decoded) -> str:
    """Return a line with one JSON object."""
    return json.dumps({"time_s": said.time_s, **json_of(said)}, separators=(",", ":"))


def read_mcap(source: BinaryIO, name: str) -> Iterator[Frame]:
    """Yield the frames of a recording by McapWriter; raises CanductorError where it is damaged."""
    count = 0
    channels: set[int] = set()
    try:
        for record in StreamReader(source, record_size_limit=RECORD_MAX).records:
            if isinstance(record, Channel) and record.topic == FRAMES and record.message_encoding == "json":
                channels.add(record.id)
            elif isinstance(record, Message) and record.channel_id in channels:
                yield _frame(record)
                count += 1
    # The reader's decompressors raise their own errors, without a common type.
    except Exception as error:
        said = str(error) if isinstance(error, McapError | ValueError) else type(error).__name__
        raise CanductorError(
            f"{name}: damaged or truncated after frame {count} ({said or type(error).__name__});"
            " the frames before were read"
        ) from error
    if not channels:
        raise CanductorError(
            f"{name}: has no channel {FRAMES} with frames; give a recording of 'canductor can record'"
        )


def _frame(record: Message) -> Frame:
    values = json.loads(record.data)
    kind = FrameKind[values["kind"].upper()]
    data = bytes.fromhex(values["data"])
    can_id, channel = values["id"], values["bus"]
    if not isinstance(can_id, int) or not 0 <= can_id < 1 << 32 or not isinstance(channel, str):
        raise ValueError("a frame without a CAN id")
    return Frame(record.log_time / _NS, can_id, data, kind, channel)

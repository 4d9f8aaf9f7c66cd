"""The second reader of a WebSocket's frames finds the messages that were not handed on."""

import bisect
import itertools
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.web.websocket_frames import UnrelayedMessages

BYTES_MAX = 300_000
TEXT, BINARY, PING, PONG = 0x81, 0x82, 0x89, 0x8A


def frame(first: int, body: bytes, mask: bytes = b"\1\2\3\4") -> bytes:
    size = len(body)
    if size < 126:
        length = bytes((0x80 | size,))
    elif size < 65_536:
        length = bytes((0x80 | 126,)) + struct.pack(">H", size)
    else:
        length = bytes((0x80 | 127,)) + struct.pack(">Q", size)
    return bytes((first,)) + length + mask + bytes(byte ^ mask[at % 4] for at, byte in enumerate(body))


def lines(messages: list[bytes]) -> bytes:
    return b"".join(message + b"\n" for message in messages)


BODIES = st.one_of(
    st.text("ab{}", max_size=8).map(str.encode),
    st.sampled_from((125, 126, 127, 65_535, 65_536)).map(lambda size: b"x" * size),
)
MASKS = st.binary(min_size=4, max_size=4)
CONTROL = st.builds(frame, st.sampled_from((PING, PONG)), st.binary(max_size=8), MASKS)


@st.composite
def messages(draw: st.DrawFn) -> tuple[bytes, bytes]:
    """A message in one frame or several, with control frames between them, and its frames."""
    parts = draw(st.lists(BODIES, min_size=1, max_size=3))
    kind = draw(st.sampled_from((0x01, 0x02)))
    data = b"".join(draw(st.lists(CONTROL, max_size=2)))
    for number, part in enumerate(parts):
        if number:
            data += b"".join(draw(st.lists(CONTROL, max_size=2)))
        data += frame((0 if number else kind) | (0x80 if number == len(parts) - 1 else 0), part, draw(MASKS))
    return b"".join(parts), data


@given(st.data())
def test_what_waits_is_what_nobody_has_looked_at(data: st.DataObject) -> None:
    sent = data.draw(st.lists(messages(), max_size=5))
    ends = list(itertools.accumulate(len(frames) for _, frames in sent))
    stream = b"".join(frames for _, frames in sent)
    unrelayed, at, looked_at = UnrelayedMessages(BYTES_MAX), 0, 0
    while at < len(stream):
        size = data.draw(st.one_of(st.integers(1, 20), st.integers(1, len(stream))))
        chunk, at = stream[at : at + size], min(at + size, len(stream))
        before, ahead = unrelayed.lines(b""), unrelayed.lines(chunk)
        assert unrelayed.lines(b"") == before, "a look takes nothing"
        unrelayed.feed(chunk)
        whole = bisect.bisect_right(ends, at)
        waiting = [message for message, _ in sent[looked_at:whole]]
        assert unrelayed.lines(b"") == ahead == lines(waiting)
        for _ in range(data.draw(st.integers(0, len(waiting)))):
            unrelayed.relayed()
            looked_at += 1
    assert unrelayed.lines(b"") == lines([message for message, _ in sent[looked_at:]])


HI = frame(TEXT, b"hi")


@pytest.mark.parametrize(
    "wrong",
    [
        b"\x81\x02hi",
        frame(0x83, b"hi"),
        frame(0xC1, b"hi"),
        frame(0x80, b"goes on"),
        frame(0x01, b"a") + frame(0x01, b"b"),
        frame(TEXT, b"x" * (BYTES_MAX + 1)),
        b"\x81\xff" + b"\xff" * 8,
        frame(0x01, b"x" * 200_000) + frame(0x80, b"x" * 200_000),
    ],
    ids=["no mask", "opcode", "reserved bit", "no begin", "begins twice", "long", "huge", "long in parts"],
)
def test_what_no_browser_sends_ends_it(wrong: bytes) -> None:
    unrelayed = UnrelayedMessages(BYTES_MAX)
    unrelayed.feed(HI)
    assert unrelayed.lines(wrong) == b"", "nor does it count what the server may not have understood"
    assert unrelayed.lines(b"") == b"hi\n"
    unrelayed.feed(wrong)
    unrelayed.feed(HI)
    assert unrelayed.lines(HI) == b""


def test_a_message_that_was_not_seen_ends_it() -> None:
    unrelayed = UnrelayedMessages(BYTES_MAX)
    unrelayed.relayed()
    unrelayed.feed(HI)
    assert unrelayed.lines(b"") == b""
    unrelayed.relayed()


def test_control_frames_are_not_kept() -> None:
    unrelayed = UnrelayedMessages(BYTES_MAX)
    unrelayed.feed(frame(PONG, b"p") * 1000 + frame(0x01, b"h"))
    unrelayed.feed(frame(PING, b"") * 1000)
    assert not unrelayed._rest
    unrelayed.feed(frame(0x80, b"i"))
    assert unrelayed.lines(b"") == b"hi\n"

"""The second reader of a WebSocket's frames finds the messages that were not handed on."""

import bisect
import itertools
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.web.websocket_frames import (
    FRAMES_MAX,
    FRAMES_PER_S,
    FRAMES_PER_TURN,
    SMALL_BYTES,
    FrameIntake,
    UnrelayedMessages,
)

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


def test_a_look_reads_no_more_frames_than_may_come_at_once() -> None:
    """Failed before: the stop lane read tens of thousands of tiny frames beside the loop."""
    unrelayed, pings = UnrelayedMessages(BYTES_MAX), frame(PING, b"")
    assert unrelayed.lines(pings * (FRAMES_MAX - 1) + HI) == b"hi\n"
    assert unrelayed.lines(pings * FRAMES_MAX + HI) == b""


# ------------------------------------------------------------------------------- how many are let through


class Intake:
    """An intake with its messages, a clock, and the floods that it has seen."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.floods = 0
        self.messages = UnrelayedMessages(BYTES_MAX)
        self.frames = FrameIntake(self.messages, lambda: self.now_s, self._flood)
        self.waiting = bytearray()

    def _flood(self) -> None:
        self.floods += 1

    def take(self, data: bytes = b"") -> bytes:
        self.waiting += data
        taken = self.frames.take(self.waiting)
        while not self.messages.is_empty:
            self.messages.relayed()
        return taken


@pytest.mark.parametrize("first", [TEXT, PING, 0x01], ids=["messages", "pings", "parts"])
def test_few_frames_at_a_time(first: int) -> None:
    intake, one = Intake(), frame(first, b"x" if first != 0x01 else b"")
    stream = one * 30 if first != 0x01 else one + frame(0x00, b"") * 29
    assert intake.take(stream) == stream[: len(one) * FRAMES_PER_TURN]
    taken = len(one) * FRAMES_PER_TURN
    while data := intake.take():
        assert len(data) <= len(one) * FRAMES_PER_TURN
        taken += len(data)
    assert taken == len(stream)


@given(st.lists(messages(), max_size=5), st.data())
def test_frames_come_through_as_they_are(sent: list[tuple[bytes, bytes]], data: st.DataObject) -> None:
    intake, stream, through, at = Intake(), b"".join(frames for _, frames in sent), b"", 0
    while at < len(stream):
        size = data.draw(st.integers(1, len(stream)))
        part, at = stream[at : at + size], at + size
        through += intake.take(part)
        while more := intake.take():
            through += more
    assert through == stream
    assert not intake.floods


def test_the_next_frames_come_when_messages_were_relayed() -> None:
    intake = Intake()
    assert not intake.frames.is_busy
    intake.frames.take(bytearray(HI))
    assert intake.frames.is_busy
    intake.messages.relayed()
    assert not intake.frames.is_busy


def test_a_flood_ends_it_once() -> None:
    intake, ping = Intake(), frame(PING, b"")
    for second in range(100):
        intake.now_s = float(second)
        for _ in range(FRAMES_PER_S):
            assert intake.take(ping) == ping
        large = frame(TEXT, b"x" * SMALL_BYTES)
        assert intake.take(large) == large, "files come in large ones"
    taken = 0
    while data := intake.take(ping):
        taken += len(data) // len(ping)
    assert taken == FRAMES_MAX - FRAMES_PER_S
    assert (bytes(intake.waiting), intake.floods, intake.frames.is_busy) == (b"", 1, True)

import itertools
import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.ipc.protocol.limits import EndReason, Limits
from coordinator.ipc.protocol.messages import Encoder, Encoding, WireReader
from tests.profiles import examples
from tests.stages.call_counter import count_calls

LIMITS = Limits(message_timeout_s=5.0)
plain = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text()
)
values = st.recursive(plain, lambda v: st.lists(v, max_size=5) | st.dictionaries(st.text(), v), max_leaves=6)
messages = st.lists(st.dictionaries(st.text(), values, max_size=4), min_size=1, max_size=5)


@settings(max_examples=examples(30))
@given(messages, st.sampled_from(Encoding), st.lists(st.integers(1, 60), min_size=1, max_size=9))
def test_messages_come_out_as_they_went_in_however_they_are_cut(
    sent: list[dict[str, Any]], encoding: Encoding, sizes: list[int]
) -> None:
    encoder, reader = Encoder(), WireReader(LIMITS)
    stream = b"".join(encoder.message(encoding, message) for message in sent)
    got = []
    for size in itertools.cycle(sizes):
        if not stream:
            break
        reader.feed(stream[:size], 0.0)
        stream = stream[size:]
        while (message := reader.next_message()) is not None:
            got.append(message)
    assert got == sent
    assert reader.encoding is encoding
    assert reader.next_deadline() is None


@settings(max_examples=examples(30))
@given(messages, st.sampled_from(Encoding), st.data())
def test_messages_before_a_byte_are_skipped(
    sent: list[dict[str, Any]], encoding: Encoding, data: st.DataObject
) -> None:
    encoder, reader = Encoder(), WireReader(LIMITS)
    reader.feed(encoder.message(encoding, {}), 0.0)
    assert reader.next_message() == {}
    pieces = [encoder.message(encoding, message) for message in sent]
    ends = list(itertools.accumulate(map(len, pieces)))
    cut = data.draw(st.integers(1, ends[-1]))
    reader.feed(b"".join(pieces)[:cut], 0.0)
    at = data.draw(st.integers(0, cut - 1))
    reader.skip_to(at)
    reader.feed(b"".join(pieces)[cut:], 0.0)
    left = [message for message, end in zip(sent, ends, strict=True) if end > at]
    assert [reader.next_message() for _ in left] == left
    assert reader.next_message() is None
    assert reader.waiting_bytes == 0


@settings(max_examples=examples(30))
@given(st.dictionaries(st.text(), values, min_size=1, max_size=3), st.sampled_from(Encoding))
def test_joined_pieces_are_one_message(part: dict[str, Any], encoding: Encoding) -> None:
    encoder, reader = Encoder(), WireReader(LIMITS)
    first, second = encoder.entries(encoding, {"a": 1}), encoder.entries(encoding, {"b": part})
    reader.feed(encoder.joined(encoding, 2, first, second), 0.0)
    assert reader.next_message() == {"a": 1, "b": part}


@settings(max_examples=examples(50))
@given(st.binary(max_size=200))
def test_garbage_ends_in_one_fault_or_waits(data: bytes) -> None:
    reader = WireReader(LIMITS)
    reader.feed(data, 1.0)
    while isinstance(reader.next_message(), dict):
        pass
    last = reader.next_message()
    assert last is None or isinstance(last, EndReason)
    if reader.waiting_bytes:
        assert reader.next_deadline() == 6.0
        assert reader.handle_timer(5.9) is None
        end = reader.handle_timer(6.0)
        assert isinstance(end, EndReason)
        assert end.code == "timeout"
        reader.feed(b"x" * 1000, 7.0)
        assert (reader.next_message(), reader.waiting_bytes) == (end, 0)


def test_a_message_that_drips_in_does_not_gain_time() -> None:
    reader = WireReader(LIMITS)
    for second in range(5):
        reader.feed(b"{"[: second == 0] or b" ", float(second))
        assert reader.next_message() is None
        assert reader.next_deadline() == 5.0


@pytest.mark.parametrize("encoding", Encoding)
@pytest.mark.parametrize("depth", [16, 17])
def test_the_limit_of_nesting_is_exact(encoding: Encoding, depth: int) -> None:
    value: Any = 1
    for _ in range(depth - 1):
        value = [value]
    reader = WireReader(LIMITS)
    reader.feed(Encoder().message(encoding, {"x": value}), 0.0)
    message = reader.next_message()
    assert isinstance(message, EndReason) == (depth > LIMITS.nesting)


@pytest.mark.parametrize("encoding", Encoding)
@pytest.mark.parametrize("value", [math.nan, math.inf, object(), b"bytes"])
def test_what_no_message_can_carry_is_an_error_of_the_sender(encoding: Encoding, value: Any) -> None:
    message = {"x": value}
    if encoding is Encoding.MSGPACK and isinstance(value, float | bytes):
        reader = WireReader(LIMITS)
        reader.feed(Encoder().message(encoding, message), 0.0)
        assert isinstance(reader.next_message(), EndReason)
        return
    with pytest.raises(ValueError, match=r"."):
        Encoder().message(encoding, message)


@pytest.mark.parametrize("empty", [b"\n", b"\r\n", b" \t\n"])
def test_empty_lines_cost_nothing_however_many_there_are(empty: bytes) -> None:
    """Failed before: 65,536 of them were read one by one, in one turn, which no limit of messages ended."""
    reader = WireReader(Limits())
    reader.feed(b'{"a":1}\n' + empty * (65_536 // len(empty)) + b'{"b":2}\n', 0.0)
    assert reader.next_message() == {"a": 1}
    found: list[object] = []
    assert count_calls(lambda: found.append(reader.next_message())) < 100
    assert found == [{"b": 2}]
    assert reader.waiting_bytes == 0

"""What is wrong with a message is found within its limits, and reported."""

import contextlib
import json
import struct
from typing import Any

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.ipc.protocol.decoding import RejectedError, check_values, decode_msgpack
from coordinator.ipc.protocol.limits import EndReason, Limits
from coordinator.ipc.protocol.messages import WireReader
from tests.profiles import examples

text = st.text(alphabet='\\",[]{}ab', max_size=12)
values = st.recursive(
    st.none() | st.integers(-(2**63), 2**64 - 1) | text,
    lambda v: st.lists(v, max_size=5) | st.dictionaries(text, v, max_size=5),
)


def items_of(value: Any) -> int:
    if not isinstance(value, dict | list):
        return 0
    return len(value) + sum(map(items_of, value.values() if isinstance(value, dict) else value))


@settings(max_examples=examples(40))
@given(st.dictionaries(text, values, min_size=1, max_size=5))
def test_the_limit_of_values_is_exact(message: dict[str, Any]) -> None:
    count = items_of(message)
    check_values(message, Limits(values=count))
    assert decode_msgpack(msgpack.packb(message), Limits(values=count)) == message
    with pytest.raises(RejectedError):
        check_values(message, Limits(values=count - 1))


@settings(max_examples=examples(60))
@given(st.binary(max_size=100), st.integers(0, 50))
def test_any_bytes_are_a_value_or_rejected(body: bytes, most: int) -> None:
    with contextlib.suppress(RejectedError):
        decode_msgpack(body, Limits(values=most))


@pytest.mark.parametrize("container", [b"\x90", b"\x80"], ids=["lists", "maps"])
def test_msgpack_makes_no_more_lists_and_maps_than_may_be(container: bytes) -> None:
    limits = Limits(values=100)
    body = b"\x81\xa1a\xdc\x00\x40" + (b"\xdc\x0f\xa0" + container * 4000) * 64
    with pytest.raises(RejectedError, match="more than 100 items"):
        decode_msgpack(body, limits)
    # What comes behind is not even looked at: these bytes are no msgpack.
    with pytest.raises(RejectedError, match="more than 100 items"):
        decode_msgpack(b"\xdc\x0f\xa0" + container * 102 + b"\xc1", limits)
    with pytest.raises(RejectedError, match="is not valid msgpack"):
        decode_msgpack(b"\xdc\x0f\xa0" + container * 99 + b"\xc1", limits)


def end_of(line: bytes) -> EndReason:
    reader = WireReader(Limits())
    reader.feed(line + b"\n", 0.0)
    end = reader.next_message()
    assert isinstance(end, EndReason)
    return end


@pytest.mark.parametrize(
    ("line", "code"),
    [
        (b'{"a":[' + b"[]," * 87_000 + b"[]]}", "too_long"),
        (b'{"a":[' + b'"",' * 87_000 + b'""]}', "too_long"),
        (b'{"a":[' + b"1," * 130_000 + b"1]}", "too_long"),
        (b'{"a":["\\\\",' + b'"\\"",' * 50_000 + b"1]}", "too_long"),
        (b'{"a":' + b"[" * 130_000 + b"]" * 130_000 + b"}", "too_deep"),
    ],
)
def test_a_line_of_too_many_items_is_rejected(line: bytes, code: str) -> None:
    assert end_of(line).code == code


@pytest.mark.parametrize("depth", [17, 500, 260_000])
def test_msgpack_that_is_too_deep_is_rejected(depth: int) -> None:
    reader = WireReader(Limits())
    body = b"\x81\xa1a" + b"\x91" * depth + b"\xc0"
    reader.feed(struct.pack(">I", len(body)) + body, 0.0)
    end = reader.next_message()
    assert isinstance(end, EndReason)
    assert end.code == "too_deep"


def test_what_stands_in_a_string_counts_for_nothing() -> None:
    reader = WireReader(Limits())
    message = {"a": "[,{" * 30_000 + '\\"' * 3_000}
    reader.feed(json.dumps(message).encode() + b"\n", 0.0)
    assert reader.next_message() == message


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        (b'{"a":NaN}', "NaN is not a JSON number; numbers are finite"),
        (b'{"a":-Infinity}', "-Infinity is not a JSON number; numbers are finite"),
        (b'{"a":' + b"9" * 5_000 + b"}", "a whole number has too many digits"),
        (b'{"a":"\xff"}', "a message has text that is not UTF-8"),
        (b'{"a":1,}', "a message is not valid JSON: "),
        (b'{"a":[' + b"1," * 4_096 + b"1]}", "a list or map has more than 4,096 items"),
    ],
)
def test_what_is_wrong_is_said(line: bytes, sentence: str) -> None:
    assert end_of(line).sentence.startswith(sentence)

"""What is wrong with a line of JSON is known before it costs much, and said."""

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.ipc.protocol.json_values import has_more_items
from coordinator.ipc.protocol.messages import Fault, WireReader
from coordinator.ipc.server.settings import Limits
from tests.profiles import examples

text = st.text(alphabet='\\",[]{}ab', max_size=12)
values = st.recursive(
    st.none() | st.integers() | text, lambda v: st.lists(v, max_size=5) | st.dictionaries(text, v, max_size=5)
)


def items_of(value: Any) -> int:
    if not isinstance(value, dict | list):
        return 0
    return len(value) + sum(map(items_of, value.values() if isinstance(value, dict) else value))


@settings(max_examples=examples(40))
@given(st.dictionaries(text, values, min_size=1, max_size=5))
def test_what_has_no_more_is_never_refused_and_twice_as_many_always_are(message: dict[str, Any]) -> None:
    body, count = json.dumps(message).encode(), items_of(message)
    assert not has_more_items(body, count)
    if count >= 4:
        assert has_more_items(body, (count - 2) // 2)


def fault_of(line: bytes) -> Fault:
    reader = WireReader(Limits())
    reader.feed(line + b"\n", 0.0)
    fault = reader.next_message()
    assert isinstance(fault, Fault)
    return fault


@pytest.mark.parametrize(
    "line",
    [
        b'{"a":[' + b"[]," * 87_000 + b"[]]}",
        b'{"a":[' + b'"",' * 87_000 + b'""]}',
        b'{"a":[' + b"1," * 130_000 + b"1]}",
        b'{"a":["\\\\",' + b'"\\"",' * 50_000 + b"1]}",
        b'{"a":' + b"[" * 130_000 + b"]" * 130_000 + b"}",
    ],
)
def test_a_line_of_too_many_items_is_not_even_parsed(line: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    def loads(*_: object, **__: object) -> None:
        raise AssertionError

    monkeypatch.setattr(json, "loads", loads)
    assert fault_of(line).code == "too_long"


def test_what_stands_in_a_string_counts_for_nothing() -> None:
    reader = WireReader(Limits())
    message = {"a": "[,{" * 30_000 + '\\"' * 3_000}
    reader.feed(json.dumps(message).encode() + b"\n", 0.0)
    assert reader.next_message() == message


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        (b'{"a":NaN}', "NaN is no number of JSON; numbers are finite"),
        (b'{"a":-Infinity}', "-Infinity is no number of JSON; numbers are finite"),
        (b'{"a":' + b"9" * 5_000 + b"}", "a whole number has too many digits"),
        (b'{"a":"\xff"}', "a message has text that is no UTF-8"),
        (b'{"a":1,}', "a message is no JSON: "),
        (b'{"a":[' + b"1," * 4_096 + b"1]}", "a list or map has more than 4,096 items"),
    ],
)
def test_what_is_wrong_is_said(line: bytes, sentence: str) -> None:
    assert fault_of(line).sentence.startswith(sentence)

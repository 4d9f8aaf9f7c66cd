from typing import Any

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.ipc.protocol.packed_values import has_more_values
from tests.profiles import examples

plain = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=300)
    | st.binary(max_size=300)
    | st.builds(msgpack.ExtType, st.integers(0, 127), st.binary(max_size=20))
)
values = st.recursive(
    plain,
    lambda v: st.lists(v, max_size=40) | st.dictionaries(st.text(max_size=40), v, max_size=20),
    max_leaves=30,
)


def count(value: Any) -> int:
    if isinstance(value, dict):
        return 1 + len(value) + sum(map(count, value.values()))
    return 1 + (sum(map(count, value)) if isinstance(value, list) else 0)


@settings(max_examples=examples(40))
@given(values)
def test_it_counts_what_a_message_has(value: Any) -> None:
    body, has = msgpack.packb(value), count(value)
    assert not has_more_values(body, has)
    # One value fewer, and it is told; unless the message is too short for so many, which needs no look.
    assert has_more_values(body, has - 1) == (len(body) > has - 1)


def test_long_ones() -> None:
    for value in (
        [0] * 70_000,
        {str(n): n for n in range(70_000)},
        "x" * 70_000,
        b"x" * 70_000,
        ["x" * 300] * 20,
    ):
        body, has = msgpack.packb(value), count(value)
        assert not has_more_values(body, has)
        assert has_more_values(body, has - 1)


@settings(max_examples=examples(60))
@given(st.binary(max_size=100), st.integers(0, 50))
def test_any_bytes(body: bytes, most: int) -> None:
    assert has_more_values(body, most) in (True, False)

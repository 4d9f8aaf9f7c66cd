"""What carries the words: bytes with pauses, a polled register, pace; ours in Python and in C alike."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.mt.mt import MtError, Pair, from_bytes, to_bytes, transmission
from nodes.mt.pace import NS_PER_S, PacedFrames, PacedWords
from nodes.virtual._sim import ffi, lib
from tests.nodes.mt import literal
from tests.nodes.mt.receiver import ByteWords, MtReceiver, PolledRegister
from tests.nodes.mt.receivers import feed

GAP = 50
bursts = st.lists(st.tuples(st.binary(max_size=9), st.integers(0, 3 * GAP)), max_size=20)


class FirmwareBytes:
    """The firmware's stream of bytes."""

    def __init__(self) -> None:
        self.raw: Any = ffi.new("struct mt_bytes *", {"gap": GAP})

    def receive(self, data: bytes, now: int) -> list[int]:
        word: Any = ffi.new("uint32_t *")
        now32 = now & 0xFFFFFFFF
        return [int(word[0]) for byte in data if lib.mt_byte(self.raw, byte, now32, word)]


@given(bursts, st.integers(0, 1 << 33))
def test_bytes_are_taken_alike_over_the_rollover_too(pieces: list[tuple[bytes, int]], start: int) -> None:
    python, firmware, now = ByteWords(GAP), FirmwareBytes(), start
    for data, pause in pieces:
        assert python.receive(data, now) == firmware.receive(data, now)
        if data:
            assert python.dropped == firmware.raw.dropped
        now += pause


def test_a_pause_begins_a_word() -> None:
    stream = ByteWords(GAP)
    assert stream.receive(b"\x01\x02\x03", 0) == []
    assert stream.receive(b"\x04\x05", GAP) == [0x04030201]
    assert stream.receive(to_bytes([7]), 2 * GAP + 1) == [7]
    assert stream.dropped == 1


def test_a_lost_byte_costs_one_transmission_and_no_more() -> None:
    table = [(1, 2), (3, 4)]
    data = to_bytes(transmission(table, [1]))
    for lost in range(len(data)):
        stream, receiver = ByteWords(GAP), MtReceiver(1, 8)
        feed(receiver, stream.receive(data[:lost] + data[lost + 1 :], 0))
        feed(receiver, stream.receive(data, GAP + 1))
        assert receiver.pairs == tuple(table), lost


@given(st.lists(st.integers(0, 3), max_size=30))
def test_a_polled_register_is_polled_alike_and_as_the_seed_has_it(values: list[int]) -> None:
    python, firmware, seed = PolledRegister(), ffi.new("struct mt_register *"), literal.ChangedOnly()
    for value in values:
        seen = python.poll(value)
        assert (seen is not None) == bool(lib.mt_poll(firmware, value))
        assert list(seed.pass_on(iter([value]))) in ([], [value])
    assert values == [] or python.poll(values[-1]) is None


def test_words_over_a_register_take_two_words_a_pair_and_ten_more_times_t() -> None:
    """The bound of the protocol: 2 * l words, and what begins and ends them, T apart."""
    delay_ns, pairs = 1000, [(2 * i, 2 * i + 1) for i in range(100)]
    words = transmission(pairs, [1])
    assert len(words) == 2 * len(pairs) + 10
    paced, sent, now_ns = PacedWords(words, delay_ns, 5), [], 5
    while paced.deadline_ns is not None:
        now_ns = paced.deadline_ns
        word = paced.take(now_ns)
        assert word is not None
        sent.append(word)
        assert paced.take(now_ns) is None
    assert sent == words
    assert now_ns == 5 + (len(words) - 1) * delay_ns


def test_equal_values_cost_a_word_more_each() -> None:
    equal: list[Pair] = [(7, 7)] * 10
    assert len(transmission(equal, [1])) == 10 + 20 + 19


def test_a_late_sender_leaves_the_drive_its_time() -> None:
    paced = PacedWords([1, 2], 1000, 0)
    assert paced.take(0) == 1
    paced.delay(500)
    assert paced.take(1499) is None, "the first was under way for so long"
    assert (paced.take(5000), paced.deadline_ns) == (2, None)
    paced.delay(500)
    assert paced.deadline_ns is None
    with pytest.raises(MtError, match="the delay between two words is -1 ns"):
        PacedWords([], -1, 0)


@given(
    st.lists(st.integers(55, 135), min_size=1, max_size=200),
    st.integers(1_000, 1_000_000),
    st.lists(st.integers(0, 20_000_000), min_size=1),
)
def test_frames_stay_within_their_budget(costs: list[int], bits_per_s: int, waits_ns: list[int]) -> None:
    burst = 8 * 135
    paced, now_ns, sent = PacedFrames(costs, bits_per_s, burst, 0), 0, 0
    for turn in range(10_000):
        if paced.deadline_ns is None:
            break
        now_ns = max(now_ns + waits_ns[turn % len(waits_ns)], paced.deadline_ns)
        sent += paced.take(now_ns)
        assert sum(costs[:sent]) <= now_ns / NS_PER_S * bits_per_s + burst + 135 + sent
    assert sent == len(costs)
    assert paced.left == 0


def test_a_budget_of_nothing_is_refused() -> None:
    with pytest.raises(MtError, match=r"a share of 0 bit/s of a bus; it must be above 0"):
        PacedFrames([100], 0, 100, 0)


@given(st.binary(max_size=40))
def test_any_bytes_are_words(data: bytes) -> None:
    assert len(from_bytes(data)) == len(data) // 4

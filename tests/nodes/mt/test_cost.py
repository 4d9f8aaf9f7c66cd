"""What transmissions cost, against counting by hand."""

import pytest

from nodes.mt.cost import AROUND, CanCost, RegisterCost, SerialCost, frame_bits, literals
from nodes.mt.mt import Pair, to_frames, transmission

TABLES: tuple[list[Pair], ...] = ([], [(1, 2), (3, 4)], [(7, 7)] * 5, [(0, -1), (-1, 0), (0, 0)])


@pytest.mark.parametrize("table", TABLES)
def test_words_are_values_literals_and_ten_around(table: list[Pair]) -> None:
    words = transmission(table, [1, 28])
    assert len(words) == 2 * len(table) + literals(words) + AROUND


def test_equal_neighbours_cost_a_literal_each() -> None:
    assert [literals(transmission(table, [1])) for table in TABLES] == [0, 0, 9, 3]


@pytest.mark.parametrize("word", [0, 0xFFFFFFFF, 0x80000000, 0xAAAAAAAA, 0x87654321])
def test_no_frame_costs_more_than_the_longest(word: int) -> None:
    frames = to_frames([word] * 4)
    for bits in frame_bits(frames):
        assert 111 <= bits <= 135, "44 + 64 bits and a pause of 3, and what is stuffed"


def test_a_register_takes_t_for_each_word() -> None:
    cost = RegisterCost(100, 213, 3, 0.002)
    assert [cost.values_s, cost.bound_s] == pytest.approx([0.4, 0.426])
    assert (
        cost.text() == "2·l·T = 2·100·2 ms = 0.400 s; with 10 words that begin and end it and 3 LIT 0.426 s"
    )


def test_a_serial_line_takes_ten_bits_a_byte() -> None:
    assert SerialCost(1152, 115_200).bound_s == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("load", "free_s", "bound_s"),
    [(0.0, 0.01, 0.05), (0.7, 0.01 / 0.3, 0.05), (0.9, 0.1, 0.1), (1.0, 10.0, 10.0)],
)
def test_a_broadcast_is_bound_by_its_share_or_by_what_others_leave(
    load: float, free_s: float, bound_s: float
) -> None:
    cost = CanCost(100, 10_000, 1_000_000, 0.2, load)
    assert cost.alone_s == pytest.approx(0.01)
    assert cost.paced_s == pytest.approx(0.05)
    assert cost.free_s == pytest.approx(free_s)
    assert cost.bound_s == pytest.approx(bound_s)
    assert ("others leave" in cost.text()) == (load > 0)

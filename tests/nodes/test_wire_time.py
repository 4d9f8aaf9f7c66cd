"""Time on the wire against the frames counted out."""

import pytest

from nodes.wire_time import can_wire_ns, narrow


@pytest.mark.parametrize(
    ("content_bytes", "bitrate", "frames"),
    [(0, 1_000_000, 1), (3, 1_000_000, 1), (4, 500_000, 2), (59, 250_000, 8)],
)
def test_a_block_is_cut_into_full_frames(content_bytes: int, bitrate: int, frames: int) -> None:
    assert can_wire_ns(content_bytes, bitrate) == frames * 111 * (1_000_000_000 // bitrate)


def test_known_time_is_taken_off_both_ends() -> None:
    assert narrow(1_000_000, 1_500_000, 111_000, 222_000) == (1_111_000, 1_278_000)


def test_an_exchange_faster_than_the_wire_is_left_alone() -> None:
    assert narrow(1_000_000, 1_300_000, 111_000, 222_000) == (1_000_000, 1_300_000)


def test_an_unknown_time_of_sending_stays_unknown() -> None:
    assert narrow(0, 1_500_000, 111_000, 222_000) == (0, 1_500_000)

"""Time on the wire against the frames counted out."""

import pytest

from nodes.clock.wire_time import can_wire_ns, narrow


@pytest.mark.parametrize(
    ("content_bytes", "bitrate", "answer", "bits"),
    [
        (1, 1_000_000, False, 44 + 6 * 8),
        (3, 1_000_000, False, 44 + 8 * 8),
        (4, 500_000, False, 111 + 44 + 8),
        (6, 500_000, True, 111 + 108),
        (59, 250_000, False, 7 * 111 + 108),
        (59, 250_000, True, 7 * 111 + 108),
    ],
)
def test_a_block_takes_at_least_its_frames(content_bytes: int, bitrate: int, answer: bool, bits: int) -> None:
    assert can_wire_ns(content_bytes, bitrate, answer=answer) == bits * (1_000_000_000 // bitrate)


def test_known_time_is_taken_off_both_ends() -> None:
    assert narrow(1_000_000, 1_500_000, 111_000, 222_000) == (1_111_000, 1_278_000)


def test_an_exchange_faster_than_the_wire_is_left_alone() -> None:
    assert narrow(1_000_000, 1_300_000, 111_000, 222_000) == (1_000_000, 1_300_000)
    assert narrow(1_000_000, 1_333_000, 111_000, 222_000) == (1_111_000, 1_111_000), "as fast as the wire"


def test_an_unknown_time_of_sending_stays_unknown() -> None:
    assert narrow(0, 1_500_000, 111_000, 222_000) == (0, 1_500_000)

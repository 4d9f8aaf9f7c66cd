"""The length of frames against a slow, obvious twin that writes every bit down."""

from hypothesis import example, given
from hypothesis import strategies as st

from nodes.virtual._hub import ffi, lib
from tests.nodes.wire_bits import bits_on_wire, crc15


@given(can_id=st.integers(0, 0x7FF), data=st.binary(max_size=8))
@example(can_id=0, data=b"")
@example(can_id=0, data=bytes(8))
@example(can_id=0x7FF, data=b"\xff" * 8)
@example(can_id=0x78, data=b"\x3c\x3c\x3c\x3c\x3c\x3c\x3c\x3c")
def test_true_length(can_id: int, data: bytes) -> None:
    bits = lib.can_frame_bits(can_id, len(data), ffi.from_buffer(data))
    assert bits == bits_on_wire(can_id, data)
    assert 47 + 8 * len(data) <= bits <= 47 + 8 * len(data) + (34 + 8 * len(data) - 1) // 4


def test_twin_divides_by_the_right_polynomial() -> None:
    assert crc15("1") == f"{0x4599:015b}"  # what x^15 leaves is the polynomial without it

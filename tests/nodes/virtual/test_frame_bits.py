"""The length of frames against a slow, obvious twin that writes every bit down."""

from hypothesis import example, given
from hypothesis import strategies as st

from nodes.virtual._hub import ffi, lib


def crc15(bits: str) -> str:
    """Long division by x^15+x^14+x^10+x^8+x^7+x^4+x^3+1, on paper."""
    divisor = "1100010110011001"
    rest = list(bits + "0" * 15)
    for at in range(len(bits)):
        if rest[at] == "1":
            for i, bit in enumerate(divisor):
                rest[at + i] = str(int(rest[at + i]) ^ int(bit))
    return "".join(rest[-15:])


def stuffed(bits: str) -> str:
    wire = ""
    for bit in bits:
        wire += bit
        if wire.endswith(("00000", "11111")):
            wire += "1" if bit == "0" else "0"
    return wire


def slow_frame_bits(can_id: int, data: bytes) -> int:
    head = f"0{can_id:011b}000{len(data):04b}" + "".join(f"{byte:08b}" for byte in data)
    wire = stuffed(head + crc15(head))
    return len(wire + "1" + "01" + "1111111" + "111")


@given(can_id=st.integers(0, 0x7FF), data=st.binary(max_size=8))
@example(can_id=0, data=b"")
@example(can_id=0, data=bytes(8))
@example(can_id=0x7FF, data=b"\xff" * 8)
@example(can_id=0x78, data=b"\x3c\x3c\x3c\x3c\x3c\x3c\x3c\x3c")
def test_true_length(can_id: int, data: bytes) -> None:
    bits = lib.can_frame_bits(can_id, len(data), ffi.from_buffer(data))
    assert bits == slow_frame_bits(can_id, data)
    assert 47 + 8 * len(data) <= bits <= 47 + 8 * len(data) + (34 + 8 * len(data) - 1) // 4


def test_twin_divides_by_the_right_polynomial() -> None:
    assert crc15("1") == f"{0x4599:015b}"  # what x^15 leaves is the polynomial without it

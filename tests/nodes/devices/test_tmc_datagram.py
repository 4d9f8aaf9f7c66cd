"""The drivers' datagrams, against the data sheet's way to compute the CRC and against known ones."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.devices import tmc_datagram

BYTES = st.binary(min_size=1, max_size=12)
REGISTERS = st.integers(0, 0x7F)
VALUES = st.integers(0, 2**32 - 1)


def remainder(data: bytes) -> int:
    """Return the remainder of a long division of polynomials: the bits as they are sent, then eight zeros."""
    bits = [byte >> at & 1 for byte in data for at in range(8)] + [0] * 8
    divisor = [1, 0, 0, 0, 0, 0, 1, 1, 1]
    for at in range(len(bits) - 8):
        if bits[at]:
            for offset, one in enumerate(divisor):
                bits[at + offset] ^= one
    return int("".join(map(str, bits[-8:])), 2)


def levels(bits: bytes) -> str:
    """Return the line's levels in the order of time."""
    return "".join(str(byte >> at & 1) for byte in bits for at in range(8))


@given(BYTES)
def test_the_crc_is_a_division_of_polynomials(data: bytes) -> None:
    assert tmc_datagram.crc8(data) == remainder(data)


@pytest.mark.parametrize(
    ("data", "crc"), [("050000", 0x48), ("050002", 0x8F), ("050006", 0x6F), ("05008000000004", 0xA9)]
)
def test_known_datagrams(data: str, crc: int) -> None:
    assert tmc_datagram.crc8(bytes.fromhex(data)) == crc


def test_a_question_bit_by_bit() -> None:
    sync, address, register, crc = "0101000001", "0100000001", "0011000001", "0"
    sent = levels(tmc_datagram.request(1, 6))
    assert sent[:30] == sync + address + register
    assert sent[30] == crc
    assert sent[31:39] == format(remainder(bytes((5, 1, 6))), "08b")[::-1]
    assert sent[39:] == "1"


@given(st.integers(0, 3), REGISTERS, VALUES)
def test_a_write_is_eight_bytes_and_ends_with_their_crc(address: int, register: int, value: int) -> None:
    bits = tmc_datagram.write(address, register, value)
    data = tmc_datagram.from_bits(bits)
    assert data is not None
    assert (len(bits), len(data)) == (10, 8)
    assert data[:3] == bytes((5, address, register | 0x80))
    assert int.from_bytes(data[3:7], "big") == value
    assert data[7] == remainder(data[:7])


def reply(register: int, value: int) -> bytes:
    data = bytes((5, 0xFF, register)) + value.to_bytes(4, "big")
    return tmc_datagram.to_bits(data + bytes((remainder(data),)))


@given(REGISTERS, VALUES)
def test_an_answer_is_read(register: int, value: int) -> None:
    assert tmc_datagram.parse_answer(reply(register, value), register) == value
    assert tmc_datagram.parse_answer(reply(register, value), register ^ 1) is None


@given(REGISTERS, VALUES, st.integers(0, 79))
def test_one_wrong_bit_is_noticed(register: int, value: int, bit: int) -> None:
    damaged = int.from_bytes(reply(register, value), "little") ^ 1 << bit
    assert tmc_datagram.parse_answer(damaged.to_bytes(10, "little"), register) is None


@given(st.binary(max_size=12), REGISTERS)
def test_garbage_is_no_answer(bits: bytes, register: int) -> None:
    value = tmc_datagram.parse_answer(bits, register)
    assert value is None or reply(register, value) == bits

"""The datagrams of stepper drivers with a UART (TMC2208, TMC2209), as defined in their data sheets.

A datagram is SYNC, address, register, four bytes of value in some, and a CRC-8. On the wire each byte is sent
lowest bit first, between a start bit (0) and a stop bit (1); nodes send and receive these bits.
"""

from collections.abc import Iterable
from typing import Final

ANSWER_BYTES: Final = 10
"""Size of an answer as bits on the wire: eight bytes of ten bits."""
_SYNC: Final = 0x05
_TO_HOST: Final = 0xFF
_WRITE: Final = 0x80
_POLYNOMIAL: Final = 0x07
_ANSWER_SIZE: Final = 8
_FRAME_BITS: Final = 10


def crc8(data: Iterable[int]) -> int:
    """Return the CRC of a datagram: polynomial x⁸ + x² + x + 1, each byte lowest bit first."""
    crc = 0
    for byte in data:
        for bit in range(8):
            feedback = crc >> 7 ^ byte >> bit & 1
            crc = crc << 1 & 0xFF ^ (_POLYNOMIAL if feedback else 0)
    return crc


def to_bits(data: bytes) -> bytes:
    """Return the bits of DATA as sent over the wire, padded with the ones of the idle line."""
    bits, count = 0, 0
    for byte in data:
        bits |= (byte << 1 | 1 << (_FRAME_BITS - 1)) << count
        count += _FRAME_BITS
    size = -(-count // 8)
    bits |= (1 << size * 8) - (1 << count)
    return bits.to_bytes(size, "little")


def from_bits(bits: bytes) -> bytes | None:
    """Return the bytes in BITS; None when a start or stop bit is wrong or bits are missing."""
    number, data = int.from_bytes(bits, "little"), bytearray()
    for at in range(0, len(bits) * 8 - _FRAME_BITS + 1, _FRAME_BITS):
        frame = number >> at & (1 << _FRAME_BITS) - 1
        if frame & 1 or not frame >> (_FRAME_BITS - 1):
            return None
        data.append(frame >> 1 & 0xFF)
    return bytes(data)


def request(address: int, register: int) -> bytes:
    """Return the bits that request a register (0 to 0x7f) of a driver (ADDRESS 0 to 3)."""
    return to_bits(_with_crc(bytes((_SYNC, address, register))))


def write(address: int, register: int, value: int) -> bytes:
    """Return the bits that set a register of a driver to VALUE (32 bits)."""
    return to_bits(_with_crc(bytes((_SYNC, address, register | _WRITE)) + value.to_bytes(4, "big")))


def parse_answer(bits: bytes, register: int) -> int | None:
    """Return the value of a register in a driver's answer; None when BITS are no such answer."""
    data = from_bits(bits)
    if data is None or len(data) != _ANSWER_SIZE or data[-1] != crc8(data[:-1]):
        return None
    if data[:3] != bytes((_SYNC, _TO_HOST, register)):
        return None
    return int.from_bytes(data[3:7], "big")


def _with_crc(data: bytes) -> bytes:
    return data + bytes((crc8(data),))

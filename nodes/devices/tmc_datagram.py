"""The datagrams of stepper drivers with a UART (TMC2208, TMC2209), as their data sheets have them.

A datagram is SYNC, address, register and perhaps four bytes of value, then a CRC-8. On the wire each byte has
a start bit (0) before and a stop bit (1) behind it, lowest bit first; nodes send and receive these bits.
"""

from collections.abc import Iterable
from typing import Final

ANSWER_BYTES: Final = 10
"""Of the bits of an answer: eight bytes of ten bits."""
REGISTER_MAX: Final = 0x7F
ADDRESS_MAX: Final = 3
_SYNC: Final = 0x05
_TO_HOST: Final = 0xFF
_WRITE: Final = 0x80
_POLYNOMIAL: Final = 0x07
_ANSWER_SIZE: Final = 8
_FRAME_BITS: Final = 10


def crc8(data: Iterable[int]) -> int:
    """Return the CRC of a datagram: polynomial x⁸ + x² + x + 1, every byte lowest bit first."""
    crc = 0
    for byte in data:
        for bit in range(8):
            feedback = crc >> 7 ^ byte >> bit & 1
            crc = crc << 1 & 0xFF ^ (_POLYNOMIAL if feedback else 0)
    return crc


def framed(data: bytes) -> bytes:
    """Return the bits of DATA as they go over the wire, filled up with the idle line's ones."""
    bits, count = 0, 0
    for byte in data:
        bits |= (byte << 1 | 1 << (_FRAME_BITS - 1)) << count
        count += _FRAME_BITS
    size = -(-count // 8)
    bits |= (1 << size * 8) - (1 << count)
    return bits.to_bytes(size, "little")


def unframed(bits: bytes) -> bytes | None:
    """Return the bytes that BITS are of; None when a start or stop bit is wrong or bits are missing."""
    number, data = int.from_bytes(bits, "little"), bytearray()
    for at in range(0, len(bits) * 8 - _FRAME_BITS + 1, _FRAME_BITS):
        frame = number >> at & (1 << _FRAME_BITS) - 1
        if frame & 1 or not frame >> (_FRAME_BITS - 1):
            return None
        data.append(frame >> 1 & 0xFF)
    return bytes(data)


def ask(address: int, register: int) -> bytes:
    """Return the bits that ask a driver (ADDRESS 0 to 3) for a register (0 to 0x7f)."""
    return framed(_closed(bytes((_SYNC, address, register))))


def write(address: int, register: int, value: int) -> bytes:
    """Return the bits that set a register of a driver to VALUE (32 bits)."""
    return framed(_closed(bytes((_SYNC, address, register | _WRITE)) + value.to_bytes(4, "big")))


def answered(bits: bytes, register: int) -> int | None:
    """Return the value of a register that a driver answered with; None for bits that are no such answer."""
    data = unframed(bits)
    if data is None or len(data) != _ANSWER_SIZE or data[-1] != crc8(data[:-1]):
        return None
    if data[:3] != bytes((_SYNC, _TO_HOST, register)):
        return None
    return int.from_bytes(data[3:7], "big")


def _closed(data: bytes) -> bytes:
    return data + bytes((crc8(data),))

"""The wire protocol once more, slow and obvious: the oracle for the C codec and for what is built on it."""

from dataclasses import dataclass
from functools import lru_cache

BLOCK_MIN, BLOCK_MAX, SYNC = 5, 64, 0x7E

# (first value, behind the last value) that fit into 1, 2, 3, 4 bytes, straight from the protocol's table.
VLQ_RANGES = [(-32, 96), (-4096, 12288), (-524288, 1572864), (-67108864, 201326592)]


def vlq_encode(value: int) -> bytes:
    """Encode VALUE in the form of its sign: a large positive number is never sent as a negative one."""
    size = next((n for n, (low, high) in enumerate(VLQ_RANGES, 1) if low <= value < high), 5)
    groups = [(value & 0xFFFFFFFF) >> (7 * n) & 0x7F for n in reversed(range(size))]
    return bytes([group | 0x80 for group in groups[:-1]] + groups[-1:])


def vlq_decode(data: bytes) -> tuple[int, bytes] | None:
    """Return (the 32 bits as unsigned, what follows); None when DATA ends early or the number is too long."""
    value = -1 if data[:1] and data[0] & 0x60 == 0x60 else 0
    for size, byte in enumerate(data[:5], 1):
        value = value << 7 | (byte & 0x7F)
        if not byte & 0x80:
            return value & 0xFFFFFFFF, data[size:]
    return None


def read_vlq(data: bytes, at: int) -> tuple[int, int]:
    """Return the number that stands at AT, signed, and where the next one begins; for sound data."""
    decoded = vlq_decode(data[at:])
    assert decoded is not None
    return signed32(decoded[0]), len(data) - len(decoded[1])


def signed32(value: int) -> int:
    return value - (1 << 32) if value & 0x80000000 else value


@lru_cache(maxsize=1 << 16)
def crc16(data: bytes) -> int:
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x8408 if crc & 1 else 0)
    return crc


def block(sequence: int, content: bytes = b"") -> bytes:
    body = bytes([len(content) + BLOCK_MIN, 0x10 | sequence & 0x0F]) + content
    return body + crc16(body).to_bytes(2, "big") + bytes([SYNC])


@dataclass
class Block:
    sequence: int
    content: bytes


def blocks(stream: bytes) -> tuple[list[Block], int, bytes]:
    """Cut STREAM into (blocks, number of damaged segments, what is not yet a whole block)."""
    found: list[Block] = []
    losses = 0
    while True:
        stream = stream.lstrip(bytes([SYNC]))
        if not stream:
            return found, losses, stream
        length = stream[0]
        wanted = length if len(stream) >= length else None
        bad = not BLOCK_MIN <= length <= BLOCK_MAX or (len(stream) > 1 and stream[1] >> 4 != 1)
        if not bad and wanted is None:
            return found, losses, stream
        if not bad and block(stream[1], stream[2 : length - 3]) == stream[:length]:
            found.append(Block(stream[1] & 0x0F, stream[2 : length - 3]))
            stream = stream[length:]
            continue
        losses += 1
        _, sync, stream = stream.partition(bytes([SYNC]))
        if not sync:
            return found, losses, b""


# What a parameter's code makes of the 32 bits: (bits kept, signed).
CODES = {"%u": (32, False), "%i": (32, True), "%hu": (16, False), "%hi": (16, True), "%c": (8, False)}


def encode_message(message_id: int, codes: list[str], values: list[int | bytes]) -> bytes:
    """One message; integers in the shortest form, as a node reads 32 bits and no sign."""
    out = vlq_encode(message_id)
    for code, value in zip(codes, values, strict=True):
        if isinstance(value, bytes):
            out += vlq_encode(len(value)) + value
        else:
            assert code in CODES
            out += vlq_encode(signed32(value & 0xFFFFFFFF))
    return out


def decode_values(codes: list[str], data: bytes) -> tuple[list[int | bytes], bytes] | None:
    values: list[int | bytes] = []
    for code in codes:
        number = vlq_decode(data)
        if number is None:
            return None
        value, data = number
        if code not in CODES:
            if value > len(data):
                return None
            values.append(data[:value])
            data = data[value:]
            continue
        bits, signed = CODES[code]
        value &= (1 << bits) - 1
        values.append(value - (1 << bits) if signed and value >> (bits - 1) else value)
    return values, data

"""What a bad line makes of one block: each entry of DAMAGES returns what arrives instead of it."""

from collections.abc import Callable, Iterable

from tests.nodes.link.virtual import MS, Delivery

Damage = Callable[[bytes], Iterable[Delivery]]


def flip(at: int, bits: int = 0x41) -> Damage:
    def damage(data: bytes) -> Iterable[Delivery]:
        # Sync bytes in front of a repeat are not what is aimed at.
        start = len(data) - len(data.lstrip(b"~"))
        place = min(start + at, len(data) - 1) if at >= 0 else len(data) + at
        return [(0, data[:place] + bytes([data[place] ^ bits]) + data[place + 1 :])]

    return damage


DAMAGES: dict[str, Damage] = {
    "dropped": lambda data: [],
    "twice": lambda data: [(0, data), (0, data)],
    "twice, late": lambda data: [(0, data), (7 * MS, data)],
    "delayed 3 ms": lambda data: [(3 * MS, data)],
    "delayed beyond the timeout": lambda data: [(150 * MS, data)],
    "length up": flip(0, 0x18),
    "length 64": lambda data: [(0, b"\x40" + data.lstrip(b"~")[1:])],
    "length out of range": flip(0, 0x80),
    "sequence": flip(1, 0x03),
    "sequence mark": flip(1, 0x40),
    "first content byte": flip(2),
    "last content byte": flip(-4),
    "checksum high": flip(-3),
    "checksum low": flip(-2),
    "sync": flip(-1),
    "first frame lost": lambda data: [(0, data[8:])],
    "middle frame lost": lambda data: [(0, data[:8] + data[16:])],
    "last frame lost": lambda data: [(0, data[: (len(data) - 1) // 8 * 8])],
    "last byte lost": lambda data: [(0, data[:-1])],
    "noise in front": lambda data: [(0, bytes(range(1, 40)) + data)],
}

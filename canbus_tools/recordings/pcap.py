"""Captures of tcpdump and Wireshark: pcap and pcapng with CAN frames, any byte order and time resolution.

Two link types carry CAN: SocketCAN, with the id in network byte order, and Linux "cooked" captures (of all
interfaces), with the id in the byte order of the capturing machine. Other packets are skipped.
"""

import struct
from collections.abc import Iterator
from typing import BinaryIO, Final

from canbus_tools.protocol.frame import Frame, FrameKind
from nodes.support.errors import CanductorError

SOCKETCAN: Final = 227
COOKED: Final = 113
COOKED_2: Final = 276
PACKET_MAX: Final = 1 << 18
"""Bytes; the limit of libpcap."""
PCAP_MAGICS: Final = {
    b"\xa1\xb2\xc3\xd4": (">", 1e-6),
    b"\xd4\xc3\xb2\xa1": ("<", 1e-6),
    b"\xa1\xb2\x3c\x4d": (">", 1e-9),
    b"\x4d\x3c\xb2\xa1": ("<", 1e-9),
}
PCAPNG_MAGIC: Final = b"\x0a\x0d\x0d\x0a"
_CAN_PROTOCOLS: Final = (0x000C, 0x000D)
_EXTENDED, _REMOTE, _ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000
_HEADER: Final = 8


def can_frame(link: int, packet: bytes, time_s: float, channel: str, order: str) -> Frame | None:
    """Read a captured packet; None: not a CAN frame. ORDER is that of the capturing machine."""
    if link == COOKED:
        protocol_at, at = 14, 16
    elif link == COOKED_2:
        protocol_at, at = 0, 20
    elif link == SOCKETCAN:
        protocol_at, at, order = None, 0, ">"
    else:
        return None
    if len(packet) < at + _HEADER:
        return None
    if protocol_at is not None and struct.unpack_from(">H", packet, protocol_at)[0] not in _CAN_PROTOCOLS:
        return None
    bits, length = struct.unpack_from(order + "IB", packet, at)
    data = packet[at + _HEADER : at + _HEADER + length]
    if length > 64 or (len(data) < length and not bits & _REMOTE):
        return None
    return Frame(time_s, bits & 0x1FFF_FFFF, data, _kind(bits, length, len(packet) - at), channel)


def _kind(bits: int, length: int, size: int) -> FrameKind:
    if bits & _ERROR:
        return FrameKind.ERROR
    if bits & _REMOTE:
        return FrameKind.REMOTE
    if length > 8 or size == 72:  # struct canfd_frame
        return FrameKind.FD
    return FrameKind.EXTENDED if bits & _EXTENDED else FrameKind.DATA


class _File:
    """A capture that is read, and the position in it."""

    def __init__(self, source: BinaryIO, name: str) -> None:
        self.name = name
        self.at = 0
        self.frames = 0
        self._source = source

    def take(self, size: int) -> bytes:
        data = self._source.read(size)
        self.at += len(data)
        if len(data) < size:
            raise self.broken("truncated packet")
        return data

    def take_or_end(self, size: int) -> bytes | None:
        """Return None at the end of the file."""
        data = self._source.read(size)
        self.at += len(data)
        if not data:
            return None
        return data + self.take(size - len(data)) if len(data) < size else data

    def broken(self, what: str) -> CanductorError:
        return CanductorError(
            f"{self.name}: {what} at byte {self.at}; the {self.frames} frames before were read"
        )

    def frame(self, frame: Frame | None) -> Iterator[Frame]:
        if frame is not None:
            self.frames += 1
            yield frame


def read_pcap(source: BinaryIO, name: str) -> Iterator[Frame]:
    """Yield the frames of a pcap file; raises CanductorError where it is damaged."""
    file = _File(source, name)
    order, unit_s = PCAP_MAGICS[file.take(4)]
    link = struct.unpack(order + "16xI", file.take(20))[0] & 0x0FFF_FFFF
    _check_link(file, link)
    head = struct.Struct(order + "IIII")
    while (raw := file.take_or_end(head.size)) is not None:
        seconds, fraction, size, _ = head.unpack(raw)
        if size > PACKET_MAX:
            raise file.broken(f"impossible packet of {size} bytes")
        yield from file.frame(can_frame(link, file.take(size), seconds + fraction * unit_s, "", order))


def _check_link(file: _File, link: int) -> None:
    if link not in (SOCKETCAN, COOKED, COOKED_2):
        raise CanductorError(
            f"{file.name}: not captured from a CAN bus (link type {link});"
            " capture a CAN interface, as in 'tcpdump -i can0 -w FILE'"
        )


# ----------------------------------------------------------------------------------------------------- pcapng

_SECTION, _INTERFACE, _SIMPLE, _ENHANCED = 0x0A0D0D0A, 1, 3, 6
_NAME_OPTION, _RESOLUTION_OPTION, _OFFSET_OPTION = 2, 9, 14
_INTERFACES_MAX: Final = 256


class _Interface:
    def __init__(self, link: int, options: dict[int, bytes], order: str) -> None:
        self.link = link
        self.name = options.get(_NAME_OPTION, b"").decode(errors="replace")
        resolution = (options.get(_RESOLUTION_OPTION) or b"\x06")[0]
        self.unit_s = 2.0 ** -(resolution & 0x7F) if resolution & 0x80 else 10.0 ** -min(resolution, 30)
        offset = options.get(_OFFSET_OPTION, b"")
        self.offset_s: int = struct.unpack(order + "q", offset)[0] if len(offset) == 8 else 0


def read_pcapng(source: BinaryIO, name: str) -> Iterator[Frame]:
    """Yield the frames of a pcapng file; raises CanductorError where it is damaged."""
    file = _File(source, name)
    order = "<"
    interfaces: list[_Interface] = []
    while (raw := file.take_or_end(8)) is not None:
        kind, size = struct.unpack(order + "II", raw)
        body = b""
        if kind == _SECTION:  # the same number in both byte orders
            body = file.take(4)
            order = ">" if body == b"\x1a\x2b\x3c\x4d" else "<"
            size = struct.unpack(order + "I", raw[4:])[0]
            interfaces = []
        if size % 4 or not 12 + len(body) <= size <= PACKET_MAX + 1024:
            raise file.broken(f"impossible block of {size} bytes")
        body += file.take(size - 12 - len(body))
        file.take(4)
        try:
            if kind == _INTERFACE and len(interfaces) < _INTERFACES_MAX:
                link = struct.unpack_from(order + "H", body)[0]
                interfaces.append(_Interface(link, _options(body[8:], order), order))
            elif kind in (_ENHANCED, _SIMPLE):
                yield from file.frame(_packet(kind, body, interfaces, order))
        except (struct.error, IndexError):
            raise file.broken("damaged block ending") from None
    if interfaces and not file.frames:
        for interface in interfaces:
            _check_link(file, interface.link)


def _packet(kind: int, body: bytes, interfaces: list[_Interface], order: str) -> Frame | None:
    if kind == _SIMPLE:
        interface = interfaces[0]
        return can_frame(interface.link, body[4:], 0.0, interface.name, order)
    number, high, low, size = struct.unpack_from(order + "IIII", body)
    interface = interfaces[number]
    time_s = ((high << 32) + low) * interface.unit_s + interface.offset_s
    if not 0 <= time_s < 1e12:
        return None
    return can_frame(interface.link, body[20 : 20 + size], time_s, interface.name, order)


def _options(data: bytes, order: str) -> dict[int, bytes]:
    found: dict[int, bytes] = {}
    at = 0
    while at + 4 <= len(data):
        code, size = struct.unpack_from(order + "HH", data, at)
        if code == 0:
            break
        found[code] = data[at + 4 : at + 4 + size]
        at += 4 + (size + 3) // 4 * 4
    return found

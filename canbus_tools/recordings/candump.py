"""Logs of can-utils' candump: the formats of ``candump -l`` and ``-L``, and of its screen output.

Accepts any bytes; reads files and live pipes.
"""

import re
from collections.abc import Callable, Iterable, Iterator
from typing import BinaryIO, Final

from canbus_tools.protocol.frame import Frame, FrameKind
from nodes.support.errors import CanductorError

CHUNK: Final = 1 << 16
LINE_MAX: Final = 1000
"""Characters; the longest frame, of CAN FD, has about 180."""
ERROR_FLAG: Final = 0x2000_0000
_HEX_ID: Final = r"([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})"
_LOG: Final = re.compile(
    rf"\s*\((\d{{1,12}}\.\d+)\)\s+(\S+)\s+{_HEX_ID}#(R[0-9A-Fa-f]?|#[0-9A-Fa-f])?((?:[0-9A-Fa-f]{{2}})*)"
    r"(?:_[0-9A-Fa-f])?(?:\s+[RT])?\s*\Z"
)
_SCREEN: Final = re.compile(
    rf"\s*(?:\((\d{{1,12}}\.\d+)\)\s+)?(\S+)\s+(?:[RT]X\s+[-BE ]{{2,3}}\s+)?{_HEX_ID}"
    r"\s+\[(\d+)\]((?:\s+[0-9A-Fa-f]{2})*)(\s+remote request)?(?:\s+ERRORFRAME|\s+'.*')?\s*\Z"
)
_IDS: Final = {form % i: i for i in range(0x800) for form in ("%03X", "%03x")}
_DATA: Final = FrameKind.DATA
_new: Final = tuple.__new__


def read_candump(
    source: BinaryIO, name: str, before_read: Callable[[], object] | None = None
) -> Iterator[list[Frame]]:
    """Yield the frames of SOURCE as they come, in lists. NAME is for messages.

    BEFORE_READ is called before each read. Raises CanductorError at the end if there were invalid lines.
    """
    read = getattr(source, "read1", source.read)  # does not wait for a whole chunk
    tail, lines_before = "", 0
    bad: list[str] = []
    bad_count = 0
    while True:
        if before_read is not None:
            before_read()
        chunk = read(CHUNK)
        lines = (tail + chunk.decode("latin-1")).split("\n")
        tail = lines.pop() if chunk else ""
        if len(tail) > LINE_MAX:
            tail = tail[:LINE_MAX]  # invalid; reported with the line's end
        frames: list[Frame] = []
        for number in _parse(lines, frames):
            bad_count += 1
            if not bad:
                bad.append(f"line {lines_before + number} {lines[number - 1][:60]!a}")
        lines_before += len(lines)
        if frames:
            yield frames
        if not chunk:
            break
    if bad:
        others = f", and {bad_count - 1} further lines are invalid" if bad_count > 1 else ""
        raise CanductorError(f"{name}: {bad[0]} is no frame of a candump log{others}; the rest was read")


def _parse(lines: Iterable[str], frames: list[Frame]) -> list[int]:
    """Append the frames of LINES to FRAMES; return the numbers of invalid lines, from 1."""
    bad: list[int] = []
    for number, line in enumerate(lines, 1):
        try:  # fast path for the usual form
            stamp, channel, said = line.split()
            can_id, mark, digits = said.partition("#")
            time_s = float(stamp[1:-1])
            if mark and stamp[0] == "(" and len(digits) <= 16 and 0 <= time_s < 1e12:
                frames.append(_new(Frame, (time_s, _IDS[can_id], bytes.fromhex(digits), _DATA, channel)))
                continue
        except (ValueError, LookupError):
            pass
        frame = _rare_frame(line[:LINE_MAX])
        if frame is not None:
            frames.append(frame)
        elif line and not line.isspace():
            bad.append(number)
    return bad


def _rare_frame(line: str) -> Frame | None:
    match = _LOG.match(line)
    if match is not None:
        stamp, channel, id_digits, mark, digits = match.groups(default="")
    else:
        match = _SCREEN.match(line)
        if match is None:
            return None
        stamp, channel, id_digits, _, digits, remote = match.groups(default="")
        mark = "R" if remote else ""
    bits = int(id_digits, 16)
    data = bytes.fromhex(digits)
    if mark[:1] == "R":
        kind = FrameKind.REMOTE
    elif bits & ERROR_FLAG and len(id_digits) == 8:
        kind = FrameKind.ERROR
    elif mark or len(data) > 8:
        kind = FrameKind.FD
    else:
        kind = FrameKind.EXTENDED if len(id_digits) == 8 else FrameKind.DATA
    if len(data) > 64 or (len(id_digits) == 3 and bits > 0x7FF):
        return None
    return Frame(float(stamp or 0), bits & 0x1FFF_FFFF, data, kind, channel)


def candump_line(frame: Frame) -> str:
    """Return the line of ``candump -l`` for a frame."""
    channel = "".join(frame.channel.split()) or "can0"
    data = frame.data.hex().upper()
    bits = frame.can_id | (ERROR_FLAG if frame.kind is FrameKind.ERROR else 0)
    digits = 8 if bits > 0x7FF or frame.kind is FrameKind.EXTENDED else 3
    content = {FrameKind.REMOTE: "#R", FrameKind.FD: f"##0{data}"}.get(frame.kind, f"#{data}")
    return f"({frame.time_s:.6f}) {channel} {bits:0{digits}X}{content}\n"

"""The line protocol of serial hosts: numbered lines in, replies and ``ok`` out; no I/O.

Each line is answered by one line that begins with ``ok``, in the order in which lines came. A line that is
damaged or not the next one is not carried out; ``Resend: N`` asks for it again.
"""

import re
from collections import deque
from dataclasses import dataclass
from functools import reduce
from operator import xor
from typing import Final

from coordinator.gcode.parser import WordError, parse
from coordinator.gcode.reply_kinds import ReplyKind, line_of
from coordinator.service.core.work import EMERGENCY
from nodes.support.terminal import printable_lines

LINE_BYTES_MAX: Final = 4_096
"""A longer line is refused."""
WAITING_BYTES_MAX: Final = 1_048_576
"""Of lines that wait; with more the host has to wait. All of it is searched for M112."""
LINE_COST_BYTES: Final = 64
"""What a line counts beyond its text."""
OUTPUT_BYTES_MAX: Final = 65_536
"""A host with more unread loses all of it."""
OK: Final = "ok"
BUSY: Final = "echo:busy: processing"
_NUMBERED: Final = re.compile(rb"[Nn](-?\d{1,9})[ \t]*")
_NUMBER_GIVEN: Final = re.compile(r"[Nn][ \t]*(-?\d{1,9})", re.ASCII)
_CHECKSUM: Final = re.compile(rb"\*[ \t]*(\d{1,3})[ \t]*$")
_STOP: Final = re.compile(rb"^[ \t]*(?:N-?\d+[ \t]*)?M0*112(?![\d.])", re.IGNORECASE | re.MULTILINE)


@dataclass(frozen=True, slots=True)
class HostLine:
    """A line that is next."""

    text: str
    """G-code without number and checksum."""
    name: str
    """Of its command; empty: there is none, or nobody can read it."""
    refusal: str = ""
    """Why it is not carried out: the answer before ``ok``."""


class SerialProtocol:
    """What a host has sent, and what it has not read yet."""

    def __init__(self) -> None:
        self._rest = bytearray()
        self._too_long = False
        """Whether the line that has begun is refused already."""
        self._waiting: deque[bytes] = deque()
        self._waiting_bytes = 0
        self._last: int | None = None
        """Number of the last line that was taken; None: the next one may have any."""
        self._output = bytearray()
        self.overflowed = False
        """Whether output was lost since this was last set to False."""

    # -------------------------------------------------------------------------------------- what comes

    @property
    def full(self) -> bool:
        """Whether no more should be read for now."""
        return self._waiting_bytes > WAITING_BYTES_MAX

    def receive(self, data: bytes) -> bool:
        """Take DATA; return whether it stops the machine. Then the lines before the stop are forgotten.

        It takes no longer than it must, however many lines there are: they are read when they are next.
        """
        *lines, rest = (bytes(self._rest) + data).split(b"\n")
        self._rest = bytearray(rest)
        if lines and self._too_long:
            self._too_long = False
            del lines[0]  # its end, which is refused with the rest of it
        stops = is_stop(b"\n".join(lines))
        if stops:
            del lines[: max(index for index, line in enumerate(lines) if is_stop(line))]
            self._waiting.clear()
            self._waiting_bytes = 0
            self._last = None
        if len(self._rest) > LINE_BYTES_MAX:
            if not self._too_long:
                lines.append(rest)
            self._too_long = True
            self._rest.clear()
        self._waiting.extend(lines)
        self._waiting_bytes += sum(map(_cost, lines))
        return stops

    def stops_with(self, data: bytes) -> bool:
        """Return whether DATA, which comes next, stops the machine; takes nothing. In any thread."""
        return is_stop((bytes(self._rest) + data).rpartition(b"\n")[0])

    def next_line(self) -> HostLine | None:
        """Return the line that is next; None: there is none."""
        if not self._waiting:
            return None
        line = self._waiting.popleft()
        self._waiting_bytes -= _cost(line)
        return self._read(line)

    def _read(self, line: bytes) -> HostLine:
        if len(line) > LINE_BYTES_MAX:
            return _refused(line_of(ReplyKind.ERROR, f"a line has more than {LINE_BYTES_MAX} bytes"))
        line = line.strip(b" \t\r")
        frame = _NUMBERED.match(line)
        return _host_line(line) if frame is None else self._read_numbered(line, int(frame[1]), frame.end())

    def _read_numbered(self, line: bytes, number: int, begin: int) -> HostLine:
        """Return what LINE with NUMBER asks for; its text begins at BEGIN."""
        if is_stop(line):
            self._last = number
            return HostLine("", "")  # it is carried out already, whatever its checksum
        checksum = _CHECKSUM.search(line, begin)
        if checksum is not None and reduce(xor, line[: checksum.start()], 0) != int(checksum[1]):
            return self._resend(number)
        found = _host_line(line[begin : len(line) if checksum is None else checksum.start()])
        if found.name == "M110":
            given = _NUMBER_GIVEN.search(found.text[4:])
            self._last = number if given is None else int(given[1])
            return found
        if self._last is not None and number != self._last + 1:
            return self._resend(number)
        self._last = number
        return found

    def _resend(self, number: int) -> HostLine:
        """Ask for the line that is missing; NUMBER, which may be damaged, where nothing came before it."""
        return _refused(f"Resend: {number if self._last is None else self._last + 1}")

    # ------------------------------------------------------------------------------------ what goes out

    def say(self, text: str) -> None:
        """Send the lines of TEXT."""
        data = "".join(f"{printable_lines(line)}\n" for line in text.split("\n")).encode(errors="replace")
        if len(self._output) + len(data) > OUTPUT_BYTES_MAX:
            self._output.clear()
            self.overflowed = True
            if len(data) > OUTPUT_BYTES_MAX:
                return
        self._output += data

    def answer(self, data: str = "") -> None:
        """Send the ``ok`` of a line, with DATA behind it."""
        self.say(f"{OK} {data}" if data else OK)

    @property
    def output(self) -> bytes:
        """What is to be sent."""
        return bytes(self._output)

    def sent(self, count: int) -> None:
        """Take note that COUNT bytes of ``output`` were sent."""
        del self._output[:count]


def is_stop(lines: bytes) -> bool:
    """Return whether one of LINES is M112, whatever its number and checksum are."""
    return _STOP.search(lines) is not None


def _host_line(line: bytes) -> HostLine:
    text = line.decode(errors="replace")
    try:
        command = parse(line)
    except WordError:
        return HostLine(text, "")  # the machine says what is wrong with it
    if command is None or command.name == EMERGENCY:  # which is carried out when it comes
        return HostLine("", "")
    return HostLine(text, command.name)


def _refused(answer: str) -> HostLine:
    return HostLine("", "", answer)


def _cost(line: bytes) -> int:
    return len(line) + LINE_COST_BYTES

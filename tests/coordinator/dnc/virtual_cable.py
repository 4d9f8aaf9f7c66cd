"""Two serial ports joined by a cable, and ``canductor dnc`` at its ends, in virtual time.

Characters take as long as on a real line. The commands run as threads in lockstep, so that each test is the
same every time.
"""

import contextlib
import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import IO, Any, Final

from coordinator.cli.parser import parse_command_line
from coordinator.dnc.commands import Environment
from coordinator.dnc.options import DncOptions
from coordinator.support.interrupts import Terminated
from nodes.support.errors import CanductorError
from tests.stages.lockstep import Lockstep, Thread

FIFO: Final = 16
"""Characters that a UART hands on at a time."""
PROGRAM: Final = b"".join(b"N%d G1 X%d.5 Y7\n" % (i, i * 7) for i in range(60))
Change = Callable[[int, bytes], bytes]
"""Gets the number of the end that sends, and what it sends; returns what arrives."""


@dataclass(frozen=True)
class Ended:
    """What a command said; its status is that of the process."""

    status: int
    text: str
    sentences: list[str]
    """About what went on; the last one is the failure, if it failed."""
    figures: dict[str, Any]


class VirtualCable:
    """Ends are the ports named "0" and "1"."""

    def __init__(self, change: Change | None = None) -> None:
        self.time = Lockstep()
        self.carried = [0, 0]
        self._change = change
        self._ends: list[deque[tuple[float, bytes]]] = [deque(), deque()]
        self._free_s = [0.0, 0.0]

    def send(self, who: int, data: bytes, character_s: float) -> None:
        """Take what end WHO sends."""
        self.carried[who] += len(data)
        if self._change is not None:
            data = self._change(who, data)
        for at in range(0, len(data), FIFO):
            piece = data[at : at + FIFO]
            self._free_s[who] = max(self.time.now_s, self._free_s[who]) + len(piece) * character_s
            self._ends[1 - who].append((self._free_s[who], piece))

    def next_s(self, who: int) -> float:
        """Return when something comes at end WHO."""
        return self._ends[who][0][0] if self._ends[who] else math.inf

    def take(self, who: int) -> bytes:
        """Return what has come at end WHO."""
        found = b""
        while self._ends[who] and self._ends[who][0][0] <= self.time.now_s:
            found += self._ends[who].popleft()[1]
        return found

    # --------------------------------------------------------------------------------------- commands

    def run(self, *words: str, typed: IO[bytes] | None = None) -> Ended:
        """Carry out ``canductor dnc WORDS`` in this thread."""
        return _Command(self, words, typed).run()

    @contextlib.contextmanager
    def started(self, *words: str, typed: IO[bytes] | None = None) -> Iterator["_Command"]:
        """Carry it out in another thread; it waits for the other side when the block begins.

        At the end of the block it is stopped, as by SIGTERM, if it has not come to an end.
        """
        command = _Command(self, words, typed)
        command.start()
        try:
            yield command
        finally:
            command.stop()


class _Port:
    """One end, as the commands see it."""

    is_paced = False

    def __init__(self, command: "_Command", who: int, options: DncOptions) -> None:
        self._command = command
        self._cable = command.cable
        self._who = who
        self._character_s = options.character_time_s

    def read(self, timeout_s: float) -> bytes:
        time, cable = self._cable.time, self._cable
        until_s = time.now_s + max(timeout_s, 0.0)
        time.wait(lambda: 0.0 if self._command.stopping else min(until_s, cable.next_s(self._who)))
        if self._command.stopping and not self._command.stopped:
            self._command.stopped = True
            raise Terminated
        return cable.take(self._who)

    def write(self, data: bytes, timeout_s: float) -> None:
        assert timeout_s > 0
        self._cable.send(self._who, data, self._character_s)

    def close(self) -> None:
        pass


class _Command:
    """A command, and what it says."""

    def __init__(self, cable: VirtualCable, words: tuple[str, ...], typed: IO[bytes] | None) -> None:
        self.cable = cable
        self.said: list[str] = []
        self.stopping = False
        self.stopped = False
        around = Environment(self._open, lambda: cable.time.now_s, self.said.append, typed)
        self._job = parse_command_line(["dnc", *words], environment=around)
        self._thread: Thread[Ended]

    def _open(self, name: str, options: DncOptions, rtscts: bool) -> _Port:
        assert not rtscts
        return _Port(self, int(name), options)

    def run(self) -> Ended:
        try:
            report = self._job()
        except CanductorError as error:
            return Ended(1, "", [*self.said, str(error)], {})
        except Terminated:
            return Ended(143, "", self.said, {})
        assert report.ok
        return Ended(0, report.to_text(), self.said, dict(report.to_json()))

    def start(self) -> None:
        time = self.cable.time
        self._thread = time.start(self.run)
        time.wait(lambda: 0.0 if self.said else math.inf)
        assert self.said[0].startswith(("waiting for a control", "serving")), self.said

    def end(self) -> Ended:
        """Wait for its end."""
        return self._thread.join()

    def stop(self) -> Ended:
        """Stop it, and wait for its end."""
        self.stopping = True
        return self._thread.join()

"""G-code typed at the terminal of a service: one line after the other, while clients are connected.

M112 does not wait for the line before it: it stops the machine when it comes; lines that wait are left out.
In the background of a shell nothing is read: what is typed is for the shell, and who reads it is stopped.
"""

import asyncio
import contextlib
import os
import select
import sys
import threading
from collections.abc import Awaitable, Callable
from typing import Final

from coordinator.ipc.protocol.methods import Caller, Registry, Scope
from coordinator.service.api.motion import BY_LINE, motion_methods
from coordinator.service.core.machine_service import MachineService
from coordinator.service.core.work import EMERGENCY, commands_in
from nodes.support.errors import CanductorError

LINES_MAX: Final = 1000
_READ_BYTES: Final = 4096
_TYPED_BYTES_MAX: Final = 16_384
"""Of lines that wait for the loop; more wait in the terminal."""
_LOOK_AGAIN_S: Final = 0.5
"""While a shell has the terminal: so long after something was typed."""
_NUMBER: Final = EMERGENCY.removeprefix("M").encode()
"""In every line with that command."""


class Typed:
    """Runs typed lines on SERVICE and passes replies to SAY, until ``close`` or the end of the input."""

    def __init__(self, service: MachineService, say: Callable[[str], None]) -> None:
        self._service = service
        registry = Registry()
        for method in motion_methods(service):
            registry.add(method)
        self._run = registry.methods["gcode.run"]
        self._say = say
        self._loop = asyncio.get_running_loop()
        self._fd = sys.stdin.fileno()
        self._rest = b""
        self._lock = threading.Lock()
        """Held while the terminal is read, by the loop or by the thread that looks for a stop."""
        self._typed = bytearray()
        """Read, maybe by that thread; the loop has it next."""
        self._ended = False
        """Whether the input has."""
        self._lines: asyncio.Queue[str] = asyncio.Queue(LINES_MAX)
        self._work = asyncio.ensure_future(self._work_off())
        self._look_again: asyncio.TimerHandle | None = None
        self._loop.add_reader(self._fd, self._read)

    def close(self) -> None:
        """Leave the terminal alone."""
        self._ended = True
        self._stop_looking()
        self._work.cancel()

    # ---- In the loop, or in the thread that looks for a stop ----

    def find_stop(self) -> str | None:
        """Return who stops the machine by a line that was typed while the loop is held; in any thread."""
        if not self._lock.acquire(blocking=False):  # the loop is just reading, maybe for ever
            return None
        try:
            before = len(self._typed), self._ended
            self._read_waiting()
            if (len(self._typed), self._ended) != before:
                with contextlib.suppress(RuntimeError):  # the loop has ended
                    self._loop.call_soon_threadsafe(self._read)
            lines = (self._rest + self._typed).split(b"\n")[:-1]
        finally:
            self._lock.release()
        return BY_LINE if any(map(_is_stop, lines)) else None

    def _read_waiting(self) -> None:
        """Read what was typed, as far as there is room for it; a terminal gives one line at a time."""
        poll = select.poll()
        poll.register(self._fd, select.POLLIN)
        while (
            len(self._typed) < _TYPED_BYTES_MAX and not self._ended and poll.poll(0) and self._has_terminal()
        ):
            try:
                data = os.read(self._fd, _READ_BYTES)
            except OSError:
                if not self._has_terminal():  # any more
                    return
                data = b""  # it is gone
            self._typed += data
            self._ended = not data

    def _has_terminal(self) -> bool:
        """Return whether what is typed is for this program: it is not in the background."""
        try:
            return os.tcgetpgrp(self._fd) == os.getpgrp()
        except OSError:  # it is not that of a shell
            return True

    # ---- In the loop ----

    def _read(self) -> None:
        with self._lock:
            self._read_waiting()
            data, self._typed = bytes(self._typed), bytearray()
        if self._ended:
            self._stop_looking()
        elif not self._has_terminal():
            self._stop_looking()
            self._look_again = self._loop.call_later(
                _LOOK_AGAIN_S, self._loop.add_reader, self._fd, self._read
            )
        self._take(data)

    def _stop_looking(self) -> None:
        self._loop.remove_reader(self._fd)
        if self._look_again is not None:
            self._look_again.cancel()

    def _take(self, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(b"\n")
        stops = [index for index, line in enumerate(lines) if _is_stop(line)]
        if stops:
            while not self._lines.empty():
                self._lines.get_nowait()
            del lines[: stops[-1] + 1]
            self._service.emergency_stop(BY_LINE)
        for line in lines:
            try:
                self._lines.put_nowait(line.decode(errors="replace"))
            except asyncio.QueueFull:
                self._say(f"more than {LINES_MAX} lines wait; a line was left out")

    async def _work_off(self) -> None:
        while True:
            line = await self._lines.get()
            if not line.strip():
                continue
            try:
                params = self._run.check({"script": line, "wait": False})
                result = self._run.call(Caller("the terminal", Scope.OPERATE), params)
                output = await result if isinstance(result, Awaitable) else result
            except CanductorError as error:
                self._say(str(error))
                continue
            assert isinstance(output, dict)
            for reply in output["replies"]:
                self._say(reply)


def _is_stop(line: bytes) -> bool:
    if _NUMBER not in line:  # most are not read twice
        return False
    try:
        return EMERGENCY in commands_in((line.decode(errors="replace"),))
    except CanductorError:  # no line of g-code
        return False

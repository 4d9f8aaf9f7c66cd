"""G-code typed at the terminal of a service: one line after the other, while clients are connected."""

import asyncio
import os
import sys
from collections.abc import Callable
from typing import Final

from coordinator.ipc.protocol.methods import Caller, Registry, Scope
from coordinator.service.api.motion import motion_methods
from coordinator.service.core.machine_service import MachineService
from nodes.support.errors import CanductorError

LINES_MAX: Final = 1000
_READ_BYTES: Final = 4096


class Typed:
    """Runs typed lines on SERVICE and passes replies to SAY, until ``close`` or the end of the input."""

    def __init__(self, service: MachineService, say: Callable[[str], None]) -> None:
        registry = Registry()
        for method in motion_methods(service):
            registry.add(method)
        self._run = registry.methods["gcode.run"]
        self._say = say
        self._loop = asyncio.get_running_loop()
        self._fd = sys.stdin.fileno()
        self._rest = b""
        self._lines: asyncio.Queue[str] = asyncio.Queue(LINES_MAX)
        self._work = asyncio.ensure_future(self._work_off())
        self._loop.add_reader(self._fd, self._read)

    def close(self) -> None:
        """Leave the terminal alone."""
        self._loop.remove_reader(self._fd)
        self._work.cancel()

    def _read(self) -> None:
        data = os.read(self._fd, _READ_BYTES)
        if not data:
            self._loop.remove_reader(self._fd)
        *lines, self._rest = (self._rest + data).split(b"\n")
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
                told = await self._run.call(Caller("the terminal", Scope.OPERATE), params)  # type: ignore[misc]
            except CanductorError as error:
                self._say(str(error))
                continue
            assert isinstance(told, dict)
            for reply in told["replies"]:
                self._say(reply)

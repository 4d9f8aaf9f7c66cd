"""What a serial host has the service do: line after line; no I/O of its own."""

import asyncio
import contextlib
import itertools
import re
from collections.abc import Callable, Coroutine, Iterator, Mapping
from typing import Any, Final

from coordinator.gcode.reply_kinds import ReplyKind, line_of
from coordinator.klippy_api.script import run_lines
from coordinator.klippy_api.status import state_of
from coordinator.serial_host.protocol import BUSY, HostLine, SerialProtocol
from coordinator.service.core.machine_service import MachineService, ServiceState
from coordinator.service.state.log_ring import Entry
from coordinator.support.version import VERSION
from nodes.support.errors import CanductorError

WHO: Final = "M112 of the serial host"
BUSY_S: Final = 2.0
"""A host that waits for a line hears that often that it is being done."""
AHEAD_MAX: Final = 64
"""Moves that are acknowledged before they are read: the feeder takes what waits every 50 ms."""
LINES_AT_ONCE: Final = 8
"""Lines that are done in one turn of the loop; empty ones, say, wait for nothing by themselves."""
_MOVES: Final = frozenset(("G0", "G1", "G2", "G3"))
_WITH_OK: Final[Mapping[str, re.Pattern[str]]] = {
    "M105": re.compile(r"(?:T\d*|B|C):"),
    "M115": re.compile(r"FIRMWARE_NAME:"),
}
"""Commands whose reply stands on the line of ``ok``, and how that begins."""
_NO_MACHINE: Final[Mapping[str, str]] = {
    "M105": "T:0",
    "M115": f"FIRMWARE_NAME:canductor FIRMWARE_VERSION:{VERSION}",
}
"""What they answer while there is no machine: hosts look by them whether anybody is there."""


class SerialHost:
    """Has SERVICE do what comes, from ``start`` to ``close``; WRITE sends what ``protocol`` has as output."""

    def __init__(self, service: MachineService, write: Callable[[], None]) -> None:
        self.protocol = SerialProtocol()
        self._service = service
        self._write = write
        self._loop = asyncio.get_running_loop()
        self._more = asyncio.Event()
        """Set when a line has come, or the state of the machine has changed."""
        self.on_room: Callable[[], None] = lambda: None
        """Hears that a line was taken: there may be room for more."""
        self._line: HostLine | None = None
        """Being carried out."""
        self._with_ok = ""
        """What goes with the ``ok`` of that line."""
        self._ahead: list[str] = []
        """Moves that are acknowledged and not handed over."""
        self._moving: asyncio.Task[None] | None = None
        """Hands them over."""
        self._room = asyncio.Event()
        """Set when there is room among those."""
        self._state = service.state
        self._work: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin."""
        self._work = self._loop.create_task(self._work_off())

    async def close(self) -> None:
        """End; a line that is being carried out is ended before its next step."""
        for task in (self._work, self._moving):
            if task is not None:
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)

    def receive(self, data: bytes) -> None:
        """Take what the host has sent; M112 in it stops the machine before this returns."""
        if self.protocol.receive(data):
            self._ahead.clear()
            self._room.set()
            self._service.emergency_stop(WHO)
        self._more.set()

    def note(self, entry: Entry) -> None:
        """Take note of a line of the service's log: the host hears what g-code answers, and states."""
        if "output" in entry:
            self._say(line_of(ReplyKind(str(entry["output"])), str(entry["text"])))
        state = self._service.state
        if state is not self._state:
            self._state_changed(state)

    def _state_changed(self, state: ServiceState) -> None:
        before, self._state = self._state, state
        if state is ServiceState.READY and before is ServiceState.STARTUP:
            self._say("// Klipper state: Ready")
        elif state in (ServiceState.SHUTDOWN, ServiceState.ERROR):
            self._say(f"// Klipper state: Shutdown\n{line_of(ReplyKind.INFORMATION, self._service.cause)}")
        elif state is ServiceState.STARTUP:
            self._say("// Klipper state: Disconnect")
        self._more.set()

    def _say(self, text: str) -> None:
        """Send TEXT, or keep it for the ``ok`` of the line that it belongs to."""
        pattern = None if self._line is None else _WITH_OK.get(self._line.name)
        if pattern is not None and not self._with_ok and pattern.match(text):
            self._with_ok = text.replace("\n", " ")
            return
        self.protocol.say(text)
        self._write()

    # ------------------------------------------------------------------------------------------- doing

    async def _work_off(self) -> None:
        for count in itertools.count(1):
            self._line, self._with_ok = self.protocol.next_line(), ""
            self.on_room()
            if self._line is None:
                self._more.clear()
                await self._more.wait()
                continue
            line = self._line
            with self._busy():
                if line.name in _MOVES and state_of(self._service)[0] == "ready":
                    await self._move(line)
                else:
                    await self._moved()
                    await self._shown(line.name, self._do(line))
            self.protocol.answer(self._with_ok)
            self._line = None
            self._write()
            if count % LINES_AT_ONCE == 0:
                await asyncio.sleep(0)

    async def _shown(self, name: str, work: Coroutine[Any, Any, None]) -> None:
        """Have WORK done, and show why it fails."""
        try:
            await work
        except (CanductorError, ValueError) as error:  # ValueError: a line that nobody can read
            self._say(line_of(ReplyKind.ERROR, str(error)))
        except Exception as bug:  # noqa: BLE001 (a bug of one command must not end the machine)
            self._loop.call_exception_handler(
                {"message": f"canductor: {name} of the serial host failed", "exception": bug}
            )
            self._say(line_of(ReplyKind.ERROR, f"{name} failed by a mistake of the program"))

    async def _move(self, line: HostLine) -> None:
        """Take a move; return when there is room for it."""
        while len(self._ahead) >= AHEAD_MAX:
            self._room.clear()
            await self._room.wait()
        self._ahead.append(line.text)
        if self._moving is None or self._moving.done():
            self._moving = self._loop.create_task(self._hand_over())

    async def _hand_over(self) -> None:
        """Hand over the moves that were acknowledged, all at once; an error ends those behind it."""
        while self._ahead:
            texts, self._ahead = self._ahead, []
            self._room.set()
            await self._shown("a move", run_lines(self._service, texts, self._say))

    async def _moved(self) -> None:
        """Wait until all acknowledged moves are read."""
        if self._moving is not None:
            await asyncio.wait((self._moving,))

    async def _do(self, line: HostLine) -> None:
        if line.refusal:
            self._say(line.refusal)
            return
        if not line.text or line.name == "M110":
            return
        if line.name in _NO_MACHINE and (
            self._service.machine is None or state_of(self._service)[0] == "startup"
        ):
            self._with_ok = _NO_MACHINE[line.name]
            return
        while self._service.state is ServiceState.STARTUP:
            self._more.clear()
            await self._more.wait()
        await run_lines(self._service, [line.text], self._say)

    @contextlib.contextmanager
    def _busy(self) -> Iterator[None]:
        """Let the host know every BUSY_S that its line is being done."""
        timers: list[asyncio.TimerHandle] = []

        def wait() -> None:
            timers[:] = [self._loop.call_later(BUSY_S, say)]

        def say() -> None:
            self.protocol.say(BUSY)
            self._write()
            wait()

        wait()
        try:
            yield
        finally:
            timers[0].cancel()

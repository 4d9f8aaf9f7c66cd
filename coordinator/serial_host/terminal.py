"""The pseudo-terminal: it reads and writes, and has the service carry out what the host sends."""

import asyncio
import contextlib
import os
import select
import stat
import termios
import threading
import tty
from pathlib import Path
from typing import Final

from coordinator.serial_host.host import WHO, SerialHost
from coordinator.serial_host.protocol import WAITING_BYTES_MAX
from coordinator.service.core.machine_service import MachineService
from nodes.support.errors import CanductorError

MODE: Final = 0o600
READ_BYTES: Final = 65_536


class PseudoTerminal:
    """Serves SERVICE to one serial host, at the link PATH, from ``start`` to ``close``; on one loop."""

    def __init__(self, service: MachineService, path: Path) -> None:
        self.host = SerialHost(service, self._write)
        """Hears the service's log (``note``)."""
        self.host.on_room = self._keep_reading
        self._path = path
        self._loop = asyncio.get_running_loop()
        self._lock = threading.Lock()
        """Held while the terminal is read, by the loop or by the thread that looks for a stop."""
        self._taken = bytearray()
        """Read by that thread; the loop has it next."""
        self._reads = self._writes = False
        """Whether the loop waits for the terminal to be readable, writable."""
        self._ours = self._theirs = -1

    # -------------------------------------------------------------------------------------------- life

    def start(self) -> None:
        """Open the terminal and make the link; raises CanductorError."""
        try:
            self._ours, self._theirs = os.openpty()
            tty.setraw(self._theirs)
            os.fchmod(self._theirs, MODE)
            os.set_blocking(self._ours, False)
            _link(self._path, os.ttyname(self._theirs))
        except OSError as error:
            self._close_ends()
            raise CanductorError(
                f"the pseudo-terminal {self._path} cannot be made: {error.strerror or error}"
            ) from None
        except CanductorError:
            self._close_ends()
            raise
        self.host.start()
        self._keep_reading()

    async def close(self) -> None:
        """Remove the link and close the terminal; a line that is being carried out is ended."""
        if self._ours < 0:
            return
        await self.host.close()
        self._loop.remove_reader(self._ours)
        self._loop.remove_writer(self._ours)
        with contextlib.suppress(OSError):
            if str(self._path.readlink()) == os.ttyname(self._theirs):
                self._path.unlink()
        with self._lock:
            self._close_ends()

    def _close_ends(self) -> None:
        for end in (self._ours, self._theirs):
            if end >= 0:
                os.close(end)
        self._ours = self._theirs = -1

    # ----------------------------------------------------------------------------------------- reading

    def find_stop(self) -> str | None:
        """Return who stops the machine by a line that waits while the loop is held; in any thread."""
        if not self._lock.acquire(blocking=False):  # the loop is just reading, or closes the terminal
            return None
        try:
            if self._ours < 0:
                return None
            if len(self._taken) < WAITING_BYTES_MAX and (data := self._read_now()):
                self._taken += data
                with contextlib.suppress(RuntimeError):  # the loop has ended
                    self._loop.call_soon_threadsafe(self._take)
            return WHO if self.host.protocol.stops_with(bytes(self._taken)) else None
        finally:
            self._lock.release()

    def _read_now(self) -> bytes:
        """Return what came; empty: nothing."""
        poll = select.poll()
        poll.register(self._ours, select.POLLIN)
        try:
            return os.read(self._ours, READ_BYTES) if poll.poll(0) else b""
        except OSError:  # it is readable no more, or nobody has it open
            return b""

    def _take(self) -> None:
        """Take what came, on the loop."""
        with self._lock:
            if self._ours < 0:
                return
            data = bytes(self._taken) + self._read_now()
            self._taken.clear()
            self.host.receive(data)
        self._keep_reading()

    def _keep_reading(self) -> None:
        """Read while there is room."""
        wanted = not self.host.protocol.full
        if wanted and not self._reads:
            self._loop.add_reader(self._ours, self._take)
        elif self._reads and not wanted:
            self._loop.remove_reader(self._ours)
        self._reads = wanted

    # ----------------------------------------------------------------------------------------- writing

    def _write(self) -> None:
        """Send what the terminal takes; without effect when it is closed."""
        if self._ours < 0:
            return
        if self.host.protocol.overflowed:
            # Nobody reads: who comes later gets what is said then, not the middle of a line of long ago.
            self.host.protocol.overflowed = False
            with contextlib.suppress(termios.error):
                termios.tcflush(self._theirs, termios.TCIFLUSH)
        with contextlib.suppress(OSError):  # it takes no more for now
            self.host.protocol.sent(os.write(self._ours, self.host.protocol.output))
        wanted = bool(self.host.protocol.output)
        if wanted and not self._writes:
            self._loop.add_writer(self._ours, self._write)
        elif self._writes and not wanted:
            self._loop.remove_writer(self._ours)
        self._writes = wanted


def _link(path: Path, target: str) -> None:
    """Make PATH a link to TARGET; a link that is there is replaced. Raises OSError, CanductorError."""
    with contextlib.suppress(FileNotFoundError):
        if not stat.S_ISLNK(path.lstat().st_mode):
            raise CanductorError(f"{path} exists and is not a link; choose another path or remove it")
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    new = path.with_name(f".{path.name}.{os.getpid()}")
    with contextlib.suppress(FileNotFoundError):
        new.unlink()
    new.symlink_to(target)
    new.replace(path)

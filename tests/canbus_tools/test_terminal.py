"""The monitor's screen in a terminal, as a process: it draws, obeys keys and leaves the terminal as it was."""

import fcntl
import os
import pty
import select
import struct
import sys
import termios
from contextlib import closing
from pathlib import Path

from nodes.assign import ADMIN_ID, SET_NODEID
from nodes.transport import CanFrame, open_can
from nodes.virtual.hub import VirtualBus

LIMIT_S = 60.0
"""Only something broken makes anyone wait so long."""
ENTER_SCREEN, LEAVE_SCREEN = b"\x1b[?1049h", b"\x1b[?1049l"


class Terminal:
    """A terminal of 80x24 with one program in it; the program is ended with it."""

    def __init__(self, *words: str) -> None:
        self.fd, self.far = pty.openpty()
        fcntl.ioctl(self.far, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        self.before = termios.tcgetattr(self.far)
        self.shown = b""
        self.pid = os.fork()
        if self.pid == 0:  # the program
            os.setsid()
            fcntl.ioctl(self.far, termios.TIOCSCTTY, 0)
            for fd in (0, 1, 2):
                os.dup2(self.far, fd)
            os.execve(sys.executable, [sys.executable, *words], {**os.environ, "TERM": "xterm-256color"})

    def wait_for(self, wanted: bytes) -> None:
        """Read what the program writes until WANTED is there."""
        while wanted not in self.shown:
            ready, _, _ = select.select([self.fd], [], [], LIMIT_S)
            assert ready, f"{wanted!r} did not come: {self.shown[-2000:]!r}"
            self.shown += os.read(self.fd, 65536)

    def type(self, keys: bytes) -> None:
        """Type KEYS."""
        os.write(self.fd, keys)

    def close(self) -> None:
        """Close the terminal; whoever still runs in it gets SIGHUP."""
        os.close(self.far)
        os.close(self.fd)


def test_a_terminal_is_left_as_it_was(tmp_path: Path) -> None:
    entry = "import sys; from coordinator.entry import main; sys.exit(main())"
    with VirtualBus(tmp_path / "bus") as bus:
        words = ("can", "monitor", "-i", "canductor", "-c", str(bus.path), "-b", "1000000")
        with closing(Terminal("-c", entry, *words)) as terminal:
            terminal.wait_for(b"Quit")  # it has drawn, and it listens
            assert ENTER_SCREEN in terminal.shown
            assert termios.tcgetattr(terminal.far) != terminal.before
            with closing(open_can(f"virtual:{bus.path}")) as host:
                host.send(CanFrame(ADMIN_ID, bytes([SET_NODEID, *bytes.fromhex("90a4ae022dfc"), 4])))
            terminal.wait_for(b"set_nodeid uuid=90a4ae022dfc nodeid=4")
            terminal.type(b"q")
            terminal.wait_for(LEAVE_SCREEN)
            _, status = os.waitpid(terminal.pid, 0)
            assert os.waitstatus_to_exitcode(status) == 0
            assert termios.tcgetattr(terminal.far) == terminal.before

"""The monitor's screen in a terminal, as a process: it draws, obeys keys, leaves the terminal as it was."""

import fcntl
import os
import pty
import select
import struct
import subprocess
import sys
import termios
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from nodes.support.can_protocol import ADMIN_ID, SET_NODEID
from nodes.transport import CanFrame, open_can
from nodes.virtual.hub import VirtualBus

LIMIT_S = 60.0
"""Only something broken makes anyone wait so long."""
ENTER_SCREEN, LEAVE_SCREEN = b"\x1b[?1049h", b"\x1b[?1049l"


class Terminal:
    """A terminal of 80x24: the test's end, and the one for a program."""

    def __init__(self) -> None:
        self._fd, self.far = pty.openpty()
        fcntl.ioctl(self.far, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        self.shown = b""

    @property
    def settings(self) -> list[object]:
        """How it treats keys and lines (termios)."""
        return list(termios.tcgetattr(self.far))

    def wait_for(self, wanted: bytes) -> None:
        """Read what the program writes until WANTED is there."""
        while wanted not in self.shown:
            ready, _, _ = select.select([self._fd], [], [], LIMIT_S)
            assert ready, f"{wanted!r} did not come: {self.shown[-2000:]!r}"
            self.shown += os.read(self._fd, 65536)

    def type(self, keys: bytes) -> None:
        """Type KEYS."""
        os.write(self._fd, keys)

    def close(self) -> None:
        """Close both ends."""
        os.close(self.far)
        os.close(self._fd)


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    with closing(Terminal()) as terminal:
        yield terminal


def test_a_terminal_is_left_as_it_was(terminal: Terminal, tmp_path: Path) -> None:
    entry = "import sys; from coordinator.cli.entry import main; sys.exit(main())"
    before = terminal.settings
    with VirtualBus(tmp_path / "bus") as bus:
        command = [sys.executable, "-c", entry, "can", "monitor", "-i", "canductor", "-c", str(bus.path)]
        with subprocess.Popen(
            command,
            stdin=terminal.far,
            stdout=terminal.far,
            stderr=terminal.far,
            env={**os.environ, "TERM": "xterm-256color"},
            start_new_session=True,
        ) as monitor:
            try:
                terminal.wait_for(b"Quit")  # it has drawn, and it listens
                assert ENTER_SCREEN in terminal.shown
                assert terminal.settings != before
                with closing(open_can(f"virtual:{bus.path}")) as host:
                    uuid = bytes.fromhex("90a4ae022dfc")
                    host.send(CanFrame(ADMIN_ID, bytes([SET_NODEID, *uuid, 4])))
                terminal.wait_for(b"set_nodeid uuid=90a4ae022dfc nodeid=4")
                terminal.type(b"q")
                terminal.wait_for(LEAVE_SCREEN)
                assert monitor.wait(LIMIT_S) == 0
            finally:
                monitor.kill()
    assert terminal.settings == before

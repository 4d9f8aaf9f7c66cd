"""A shell with a terminal (standard input) and a service in its background: ``python -m … CASE``.

The exit status is 0, or a sentence says what stopped or failed. The service runs in virtual time.
"""

import asyncio
import fcntl
import os
import signal
import sys
import termios
from collections.abc import Callable
from typing import Final, NoReturn

from coordinator.ipc.server.state import StateTree
from coordinator.runtime.linux_host import LinuxHost
from coordinator.service.core.machine_service import MachineService, ServiceSettings
from coordinator.service.core.typed import Typed
from coordinator.support.interrupts import run_to_end
from tests.stages.jump_loop import JumpLoop, run

LONG_S: Final = 10.0


def _load() -> NoReturn:
    raise AssertionError("the service is not run")


async def _wait_for_the_foreground() -> None:
    """Leave what is typed alone, without being stopped or busy, until the shell gives us the terminal."""
    said: list[str] = []
    service = MachineService(
        _load, LinuxHost(), StateTree(), ServiceSettings(name="test"), on_line=lambda _entry: None
    )
    typed = Typed(service, said.append)
    await asyncio.sleep(LONG_S)
    assert typed.find_stop() is None
    assert said == []
    signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGTTOU,))  # the shell's part: fg
    os.tcsetpgrp(0, os.getpgrp())
    while not said:  # noqa: ASYNC110 (there is no event for it)
        await asyncio.sleep(1.0)
    typed.close()


async def _lose_the_terminal() -> None:
    """The same, where the shell takes the terminal between the look at it and the reading."""
    look = os.tcgetpgrp

    def late(_fd: int) -> int:
        os.tcgetpgrp = look
        return os.getpgrp()

    os.tcgetpgrp = late
    await _wait_for_the_foreground()


async def _write() -> None:
    os.write(0, b"a reply\n")


CASES: Final[dict[str, Callable[[], object]]] = {
    "typed": lambda: run(_wait_for_the_foreground()),
    "late": lambda: run_to_end(_lose_the_terminal, JumpLoop),
    "writes": lambda: run_to_end(_write, JumpLoop),
}


def main() -> None:
    """Run a case as the leader of a session that has the terminal."""
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
    settings = termios.tcgetattr(0)
    settings[3] |= termios.TOSTOP
    termios.tcsetattr(0, termios.TCSANOW, settings)
    job = os.fork()
    if job == 0:
        os.setpgid(0, 0)
        CASES[sys.argv[1]]()
        return
    _, status = os.waitpid(job, os.WUNTRACED)
    if os.WIFSTOPPED(status):
        os.kill(job, signal.SIGKILL)
        sys.exit(f"stopped by {signal.Signals(os.WSTOPSIG(status)).name}")
    sys.exit(os.waitstatus_to_exitcode(status))


if __name__ == "__main__":
    main()

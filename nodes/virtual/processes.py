"""Starts and ends the processes of virtual hardware, such as firmware nodes.

They print one JSON line when they are ready and, on SIGTERM, one with their counters. They end with this
process, however it ends: the kernel sends them SIGKILL (PR_SET_PDEATHSIG, set by util-linux's ``setpriv``
between fork and exec, where Python code would not be safe). The kernel monitors the *thread* that forked, so
all are started from one thread that lives as long as the interpreter. They have a session of their own:
Ctrl-C at the terminal reaches only this process, which ends them in order.
"""

import contextlib
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from nodes.support.errors import CanductorError

BIN_DIR = Path(__file__).parent / "bin"
READY_TIMEOUT_S = 30.0
STOP_TIMEOUT_S = 20.0
"""Long enough for a busy computer; both take some hundredths of a second."""
EXIT_TIMEOUT_S = 2.0
"""From the end of a process's output to its exit, on a busy computer."""
LINE_MAX = 65_536
"""Most bytes of a line of a child."""
_STDERR_TAIL = 500
"""Last bytes of a child's stderr that an error message quotes."""

Flavour = Literal["mainboard", "toolhead", "uart"]

_starter = ThreadPoolExecutor(max_workers=1, thread_name_prefix="process starter")


class ChildProcess:
    """A process that reports, in one JSON line each, when it is ready and when it ends. NAME is for messages.

    The constructor only starts it, so that several can start at the same time; call wait_ready() then. Use it
    in one thread. As a context manager it is stopped, or killed when an exception leaves the block.
    """

    def __init__(self, name: str, command: Sequence[str | Path]) -> None:
        """Start COMMAND; raises CanductorError when that fails."""
        self.name = name
        self.ready: dict[str, Any] | None = None
        """The line that the process printed when it was ready."""
        self._statistics: dict[str, Any] | None = None
        self._received = b""
        setpriv = shutil.which("setpriv")
        if setpriv is None:
            raise CanductorError(
                f"{name}: cannot be started without 'setpriv'; install the package util-linux"
            )
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115  (a pipe that nobody reads would block the process)
        try:
            self._process: subprocess.Popen[bytes] = _starter.submit(
                subprocess.Popen,
                [setpriv, "--pdeathsig", "KILL", "--", *(str(word) for word in command)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=self._stderr,
                start_new_session=True,
            ).result()
        except OSError as error:
            self._stderr.close()
            raise CanductorError(f"{name}: cannot start a process: {error.strerror}") from error

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def wait_ready(self, timeout_s: float = READY_TIMEOUT_S) -> dict[str, Any]:
        """Return the line of a ready process; if there is none, kill it and raise CanductorError."""
        if self.ready is None:
            line = self._read_line(timeout_s)
            if line is None or line.get("ready") is not True:
                raise self._failure("did not become ready", timeout_s)
            self.ready = line
        return self.ready

    def stop(self, timeout_s: float = STOP_TIMEOUT_S) -> dict[str, Any]:
        """End the process and return its counters; further calls return them again.

        Raises CanductorError when it had ended before, does not end in time (it is killed), or ends with an
        error.
        """
        if self._statistics is None and self.running:
            self._process.terminate()
        return self.wait_end(timeout_s)

    def wait_end(self, timeout_s: float = STOP_TIMEOUT_S) -> dict[str, Any]:
        """Wait until the process ends by itself, and return its counters; errors as for stop()."""
        if self._statistics is not None:
            return self._statistics
        deadline_s = time.monotonic() + timeout_s
        line = self._read_line(timeout_s)
        if line is not None and line.get("ready") is True:  # it was stopped before wait_ready()
            line = self._read_line(deadline_s - time.monotonic())
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(max(0.0, deadline_s - time.monotonic()))
        if line is None or self._process.returncode != 0:
            raise self._failure("did not end correctly", timeout_s)
        self._close()
        self._statistics = line
        return line

    def signal(self, number: int) -> None:
        """Send signal NUMBER to the process."""
        self._process.send_signal(number)

    def kill(self) -> None:
        """Kill the process, without counters; no effect when it has ended."""
        self._process.kill()
        self._process.wait()
        self._close()

    def _close(self) -> None:
        assert self._process.stdout is not None
        self._process.stdout.close()
        self._stderr.close()

    def _read_line(self, timeout_s: float) -> dict[str, Any] | None:
        """Return the process's next JSON line; None when there is none, or another line."""
        deadline_s = time.monotonic() + timeout_s
        assert self._process.stdout is not None
        if self._process.stdout.closed:
            return None
        fd = self._process.stdout.fileno()
        poller = select.poll()
        poller.register(fd, select.POLLIN)
        while b"\n" not in self._received:
            if not poller.poll(max(0.0, deadline_s - time.monotonic()) * 1000):
                return None
            data = os.read(fd, 4096)
            self._received += data
            if not data or len(self._received) > LINE_MAX:
                return None
        line, _, self._received = self._received.partition(b"\n")
        try:
            value = json.loads(line)
        except ValueError:
            return None
        return value if isinstance(value, dict) else None

    def _failure(self, what: str, timeout_s: float) -> CanductorError:
        """Return the error with its cause, and make sure that the process has ended."""
        if self._process.stdout is not None and self._process.stdout.closed:
            return CanductorError(f"{self.name} {what}: it was killed before")
        # Its output may end shortly before the process itself.
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(min(timeout_s, EXIT_TIMEOUT_S))
        status = self._process.poll()
        if status is None:
            reason = f"no answer in {timeout_s:g} s; it was killed"
        elif status < 0:
            reason = f"ended by signal {-status}"
        else:
            reason = f"ended with status {status}"
        self._process.kill()
        self._process.wait()
        self._stderr.seek(max(0, self._stderr.seek(0, os.SEEK_END) - _STDERR_TAIL))
        words = " ".join(self._stderr.read().decode(errors="replace").split())
        self._close()
        return CanductorError(f"{self.name} {what}: {reason}" + (f": {words}" if words else ""))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self.kill()
        elif not self._stderr.closed:
            self.stop()


class NodeProcess(ChildProcess):
    """A virtual node: the project's firmware as a process.

    FLAVOUR is its kind of board. Exactly one of ``can`` (a virtual bus's socket), ``socketcan`` (an
    interface) and ``uart`` (path of the link to the node's pseudo-terminal) defines its connection.
    ``rate_ppm``: rate error of its clock; ``start_clock``: its clock at the start. ``jitter_us``,
    ``slice_us`` and ``seed``: see the firmware. ``legacy``: it behaves as a board with Klipper firmware,
    without this project's extensions of the CAN protocol. ``plant``: the description of its plant (plant.py),
    in whose folder the process writes its page and, with ``plant_log``, its log, which grows as long as it
    runs.
    """

    def __init__(
        self,
        flavour: Flavour,
        *,
        uuid: str,
        can: Path | None = None,
        socketcan: str | None = None,
        uart: Path | None = None,
        rate_ppm: float = 0.0,
        start_clock: int | None = None,
        jitter_us: int | None = None,
        slice_us: int | None = None,
        seed: int | None = None,
        edge_log: Path | None = None,
        legacy: bool = False,
        plant: Path | None = None,
        plant_log: bool = True,
        name: str | None = None,
        bin_dir: Path = BIN_DIR,
    ) -> None:
        """Start the node; raises CanductorError. None: the firmware's default."""
        name = name or f"virtual node {flavour}"
        links = {"--can": can, "--socketcan": socketcan, "--uart": uart}
        if sum(link is not None for link in links.values()) != 1:
            raise CanductorError(f"{name}: give exactly one of can, socketcan and uart")
        executable = bin_dir / f"canductor-node-{flavour}"
        if not executable.is_file():
            raise CanductorError(f"{name}: its firmware {executable} is missing; build it with 'make setup'")
        options = links | {
            "--uuid": uuid,
            "--rate-ppm": rate_ppm,
            "--start-clock": start_clock,
            "--jitter-us": jitter_us,
            "--slice-us": slice_us,
            "--seed": seed,
            "--edge-log": edge_log,
            "--legacy": 1 if legacy else None,
            "--plant": plant,
            "--plant-log": None if plant_log else 0,
        }
        command: list[str | Path] = [executable]
        for option, value in options.items():
            if value is not None:
                command += [option, str(value)]
        super().__init__(name, command)

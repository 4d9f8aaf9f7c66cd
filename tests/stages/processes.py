"""Virtual hardware and the ``canductor`` command, as a user has them: everything is a real process."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any, Self

from nodes.virtual.processes import ChildProcess, NodeProcess
from tests.stages.bus_process import BusProcess
from tests.stages.printer_text import DEMO_CFG, without_endstops

ROOT = Path(__file__).parents[2]
CANDUCTOR = (sys.executable, "-m", "coordinator.cli.main")
MCU_UUID, TOOLHEAD_UUID = "90a4ae022dfc", "5e1ec7ab1e02"
END_S = 60.0
"""No command of these tests may take longer; on a busy machine they take a third of it."""

SLOW = """\
G28
G4 P1500
G1 X5 Y4 F300
M83
G1 Z0.6 F300
G1 E0.5 F300
"""
"""Every stepper of the demo machine moves, slowly; the first commands are sent as early as all others."""

LONG = "G28\nG4 P1500\nG1 X200 F180\n"
"""More than a minute."""


@dataclasses.dataclass(frozen=True)
class Ended:
    """A command that has ended."""

    status: int
    stdout: str
    stderr: str
    took_s: float

    @property
    def json(self) -> dict[str, Any]:
        value = json.loads(self.stdout.splitlines()[-1])
        assert isinstance(value, dict)
        return value

    def sentence(self, status: int = 1) -> str:
        """Return the one sentence the command failed with, having checked that it is only one."""
        assert "Traceback" not in self.stdout + self.stderr
        assert self.status == status, self
        lines = [line for line in self.stderr.splitlines() if not line.startswith("printing ")]
        assert len(lines) == 1, lines
        assert lines[0].startswith("canductor: ")
        return lines[0].removeprefix("canductor: ")


def own_port(number: int) -> int:
    """Return a port of 127.0.0.1 that no other process of tests takes; none is given to clients by chance."""
    return 10_000 + number + 10 * (os.getpid() % 2000)


class _Output:
    """What a process writes to PIPE, line by line, read by a thread of its own."""

    def __init__(self, pipe: IO[str]) -> None:
        self._lines: list[str] = []
        self._ended = False
        self._news = threading.Condition()
        self._reader = threading.Thread(target=self._read, args=(pipe,), daemon=True)
        self._reader.start()

    def _read(self, pipe: IO[str]) -> None:
        with pipe:
            for line in pipe:
                with self._news:
                    self._lines.append(line)
                    self._news.notify_all()
        with self._news:
            self._ended = True
            self._news.notify_all()

    def wait_for(self, words: str, limit_s: float = END_S) -> None:
        """Wait until a line had WORDS in it."""

        def found() -> bool:
            return any(words in line for line in self._lines)

        with self._news:
            self._news.wait_for(lambda: self._ended or found(), limit_s)
            assert found(), f"{words!r} was not said, but {self._lines}"

    def word_after(self, words: str) -> str:
        """Return the word that follows WORDS, once a line has them."""
        self.wait_for(words)
        with self._news:
            return next(line for line in self._lines if words in line).partition(words)[2].split()[0]

    def all(self) -> str:
        self._reader.join(END_S)
        assert self._ended
        return "".join(self._lines)


class Command:
    """A ``canductor`` command while it runs; its standard input is a pipe.

    PROGRAM is another installation's, if it is given, FOLDER where it runs, and ENVIRONMENT what it inherits.
    """

    def __init__(
        self,
        *words: str | Path,
        program: Sequence[str] = CANDUCTOR,
        folder: Path = ROOT,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._began_s = time.monotonic()
        self.process = subprocess.Popen(
            [*program, *map(str, words)],
            cwd=folder,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdin
        assert self.process.stdout
        assert self.process.stderr
        self._stdin = self.process.stdin
        self.stdout, self.stderr = _Output(self.process.stdout), _Output(self.process.stderr)

    def type(self, *lines: str) -> None:
        """Write LINES to its standard input."""
        self._stdin.write("".join(line + "\n" for line in lines))
        self._stdin.flush()

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def end(self) -> Ended:
        """Close its input and wait for it."""
        self._stdin.close()
        status = self.process.wait(END_S)
        return Ended(status, self.stdout.all(), self.stderr.all(), time.monotonic() - self._began_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
        if not self._stdin.closed:
            self._stdin.close()


def canductor(*words: str | Path) -> Ended:
    """Run a command to its end."""
    with Command(*words) as command:
        return command.end()


def write_config(folder: Path, *, name: str = "machine.cfg", **replaced: str) -> Path:
    """Write the demo's configuration for the virtual hardware in FOLDER; REPLACED: words by words.

    It has no endstops: nothing around these nodes would press them, and G28 takes the axes as home.
    """
    text = DEMO_CFG.replace("canbus_interface: can0", f"canbus_interface: virtual:{folder / 'bus'}")
    text = without_endstops(text, {"/dev/ttyUSB0": str(folder / "zboard.tty")})
    for old, new in replaced.items():
        assert old in text
        text = text.replace(old, new)
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


@dataclasses.dataclass(frozen=True)
class Hardware:
    """A bus with two nodes, and one on a UART; ``config`` describes the machine they make."""

    folder: Path
    config: Path
    bus: BusProcess
    nodes: Mapping[str, NodeProcess]

    def stop(self, *names: str) -> list[dict[str, Any]]:
        """End these nodes (all, if none is named) and return their counters."""
        return [self.nodes[name].stop() for name in names or self.nodes]


@contextmanager
def hardware(folder: Path) -> Iterator[Hardware]:
    """Start the virtual hardware of the demo machine in FOLDER."""
    with ExitStack() as stack:

        def started(process: ChildProcess) -> None:
            stack.callback(process.kill)
            process.wait_ready()

        bus = BusProcess(folder / "bus")
        started(bus)
        nodes = {
            "mcu": NodeProcess("mainboard", uuid=MCU_UUID, can=folder / "bus"),
            "toolhead": NodeProcess("toolhead", uuid=TOOLHEAD_UUID, can=folder / "bus", rate_ppm=80),
            "zboard": NodeProcess("uart", uuid="000000000000", uart=folder / "zboard.tty", rate_ppm=-90),
        }
        for node in nodes.values():
            started(node)
        yield Hardware(folder, write_config(folder), bus, nodes)


def write_gcode(folder: Path, text: str | Sequence[str]) -> Path:
    path = folder / "job.gcode"
    path.write_text(text if isinstance(text, str) else "\n".join(text) + "\n", encoding="utf-8")
    return path

"""Firmware that this project did not make, as processes on pseudo-terminals, and a machine service on it.

The images lie outside the project; a test that needs one that is missing is skipped. Two boards exist: the
Linux process, with pins, sensors and axes by the shim in ../shared/tools, and an ATmega2560 in libsimavr
(avr_board.c in this folder; Debian package libsimavr-dev).
"""

import lzma
import shutil
import struct
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, Self

import pytest

from coordinator.ipc.client.blocking import BlockingClient
from tests.stages.processes import END_S, Command

SHARED: Final = Path(__file__).parents[2] / ".." / "shared"
LINUX_PROCESS: Final = SHARED / "data" / "firmware" / "klipper-linux-process.elf.xz"
LINUX_MACHINE: Final = SHARED / "data" / "firmware" / "klipper-linux.cfg"
SHIM: Final = SHARED / "tools" / "gpioshim.c"
ATMEGA2560: Final = SHARED / "data" / "firmware" / "klipper-atmega2560.hex"
AVR_BOARD: Final = Path(__file__).parent / "avr_board.c"

NEAR_HOME: Final = """\
axis X 1 2 0 0 3 0 1 0 80
axis Y 4 5 1 0 6 0 1 0 80
axis Z 7 8 0 0 9 -320 1 1 0
axis E 10 11 0 0 -1 0 1 0 0
heater bed 20 0 3.0 0.01
heater hot 21 1 6.0 0.015
"""
"""What stands around the pins of the machine in LINUX_MACHINE: near its endstops, so that it homes soon."""
_POSITIONS: Final = struct.Struct("<Q16q")
"""The beginning of the shim's state: a magic number, and where its axes are, in steps."""


def need(*files: Path) -> None:
    """Skip the test unless FILES and a C compiler are there."""
    for file in files:
        if not file.is_file():
            pytest.skip(f"there is no {file.name} in ../shared")
    if shutil.which("gcc") is None:
        pytest.skip("there is no gcc")


class LinuxProcess:
    """Firmware as a Linux process in FOLDER; ``device`` is its pseudo-terminal. NAME: of its files."""

    def __init__(self, folder: Path, name: str = "mcu", plant: str = NEAR_HOME) -> None:
        need(LINUX_PROCESS, SHIM)
        self.device = folder / f"{name}.tty"
        self._state = folder / f"{name}.state"
        self._image, shim, plant_file = folder / "firmware", folder / "shim.so", folder / f"{name}.plant"
        if not self._image.exists():
            self._image.write_bytes(lzma.decompress(LINUX_PROCESS.read_bytes()))
            self._image.chmod(0o755)
            compile_c(SHIM, shim, "-shared", "-fPIC", "-ldl", "-lm")
        plant_file.write_text(plant, encoding="utf-8")
        self._variables = {
            "SHIM_STATE": str(self._state),
            "SHIM_PLANT": str(plant_file),
            "LD_PRELOAD": str(shim),
        }
        self._process = self._started()

    def _started(self) -> subprocess.Popen[bytes]:
        setpriv = ("setpriv", "--pdeathsig", "KILL")
        variables = (f"{name}={value}" for name, value in self._variables.items())
        process = subprocess.Popen(
            [*setpriv, "env", *variables, str(self._image), "-I", str(self.device)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        wait_for_device(self.device, process)
        return process

    def positions(self) -> tuple[int, ...]:
        """Return where the axes truly are, in steps."""
        return _POSITIONS.unpack(self._state.read_bytes()[: _POSITIONS.size])[1:]

    def kill(self) -> None:
        """End the process at once; its pseudo-terminal is gone, the link remains."""
        self._process.kill()
        self._process.wait()

    def start_again(self) -> None:
        """Start the process again after ``kill``; its pseudo-terminal is a new one."""
        self.device.unlink(missing_ok=True)
        self._process = self._started()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


class AvrBoard:
    """An ATmega2560 in FOLDER. DEAF_S: its boot loader; GONE_S: how long its device disappears at a reset.

    DTR: whether it is reset whenever its device is opened.
    """

    def __init__(self, folder: Path, *, deaf_s: float = 0.0, gone_s: float = 0.0, dtr: bool = False) -> None:
        need(ATMEGA2560)
        program = folder / "avr_board"
        if not program.exists():
            if not Path("/usr/include/simavr/sim_avr.h").exists():
                pytest.skip("libsimavr is not installed (Debian package libsimavr-dev)")
            compile_c(AVR_BOARD, program, "-lsimavr", "-lelf")
        self.device = folder / "avr.tty"
        self.device.unlink(missing_ok=True)
        times = (f"{round(1000 * deaf_s)}", f"{round(1000 * gone_s)}", str(int(dtr)))
        self._process = subprocess.Popen(
            [program, ATMEGA2560, self.device, *times], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL
        )
        wait_for_device(self.device, self._process)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()  # which ends it
        self._process.wait(END_S)


def compile_c(source: Path, result: Path, *options: str) -> None:
    """Compile SOURCE; fails with the compiler's words."""
    done = subprocess.run(
        ["gcc", "-std=gnu11", "-O2", "-w", "-o", result, source, *options], capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr.decode()


def wait_for_device(device: Path, process: subprocess.Popen[bytes]) -> None:
    """Return when DEVICE exists; fails when its PROCESS ends first."""
    end_s = time.monotonic() + END_S
    while not device.exists():
        assert process.poll() is None, f"the firmware ended with status {process.returncode}"
        assert time.monotonic() < end_s, f"{device} does not appear"
        time.sleep(0.01)


class ForeignService:
    """A machine service as a process, and its client."""

    def __init__(self, client: BlockingClient) -> None:
        self.client = client

    def until(self, state: str, starts: int = 0) -> int:
        """Wait until the machine is in STATE, in start STARTS or later; return which start it is."""
        seen: dict[str, Any] = {}
        updates = self.client.watch(["machine.state", "machine.starts", "machine.cause"], rate_hz=50)
        for update in updates:
            seen.update(update.values)
            begun = seen["machine.starts"] >= starts
            if begun and seen["machine.state"] == state:
                break
            assert not begun or seen["machine.state"] != "error", seen
        updates.close()
        assert seen["machine.state"] == state
        return int(seen["machine.starts"])

    def restart(self, state: str = "ready", *, firmware: bool) -> None:
        """Start the machine again, which is in STATE now; wait until it is ready."""
        starts = self.until(state)
        self.client.call("machine.restart", {"firmware": firmware})
        self.until("ready", starts + 1)

    def run(self, script: str) -> None:
        """Run lines of G-code to their end."""
        self.client.call("gcode.run", {"script": script})

    def step_counts(self) -> Mapping[str, int]:
        """Return the steps by the nodes' own count, having compared them with those sent."""
        answer: dict[str, Any] = self.client.call("position.get", {"ask_nodes": True})
        counts: dict[str, int] = answer["nodes_steps"]
        assert counts == {name: stepper["steps_sent"] for name, stepper in answer["steppers"].items()}, answer
        return counts


@contextmanager
def foreign_service(config: Path) -> Iterator[ForeignService]:
    """Run a service of the machine in CONFIG, ready when the block begins."""
    path = config.parent / "run.sock"
    with Command("run", config, "--jobs", config.parent, "--ipc", path) as command:
        command.stdout.wait_for("ready")
        with BlockingClient(str(path)) as client:
            yield ForeignService(client)

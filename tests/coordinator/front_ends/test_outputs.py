"""What a command prints while a machine moves, where the outputs are full, closed, or not read."""

import os
import pty
import sys
import termios
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from coordinator.demo import run as demo
from coordinator.demo.run import DemoOptions, run_demo
from coordinator.front_ends.outputs import is_behind, outputs_in_threads
from coordinator.front_ends.writing_thread import WAITING_MAX
from coordinator.service.core.job_runner import OnProgress
from coordinator.support.progress import Progress, ProgressDisplay
from nodes.support.errors import CanductorError
from nodes.support.terminal import OutputError, show, show_error

LINES = 3 * WAITING_MAX


@contextmanager
def paused_terminal() -> Iterator[int]:
    """Make standard output a terminal that is paused, as by Ctrl-S; yield the user's end of it.

    Who writes to it directly fails instead of waiting.
    """
    user, terminal = pty.openpty()
    termios.tcflow(terminal, termios.TCOOFF)
    os.set_blocking(terminal, False)
    with (
        os.fdopen(user, "rb", buffering=0),
        os.fdopen(terminal, "w", encoding="utf-8") as stream,
        redirect_stdout(stream),
    ):
        yield user


@contextmanager
def full_disk() -> Iterator[None]:
    """Make standard output a file on a full disk."""
    with Path("/dev/full").open("w", encoding="utf-8") as stream, redirect_stdout(stream):
        yield


def print_and_go_on() -> None:
    with outputs_in_threads():
        for _ in range(3):
            show("a reply")


def test_a_full_disk_is_reported_at_the_end() -> None:
    with full_disk():
        with pytest.raises(OutputError, match="cannot write the output: no space left on device"):
            print_and_go_on()
        show("goes nowhere, and is no second mistake")


def test_a_reader_that_is_gone_is_reported_at_the_end() -> None:
    reads, writes = os.pipe()
    os.close(reads)
    stream = os.fdopen(writes, "w", encoding="utf-8")
    with stream, redirect_stdout(stream), pytest.raises(BrokenPipeError):
        print_and_go_on()


def test_why_the_machine_stopped_is_reported_first() -> None:
    def stop() -> None:
        with outputs_in_threads():
            show("a reply")
            raise CanductorError("lost node mcu")

    with full_disk(), pytest.raises(CanductorError, match="lost node mcu"):
        stop()


def test_standard_error_may_be_lost() -> None:
    with (
        Path("/dev/full").open("w", encoding="utf-8") as stream,
        redirect_stderr(stream),
        outputs_in_threads(),
    ):
        show_error("some progress")


def test_who_prints_does_not_wait_for_a_paused_terminal() -> None:
    numbers, left_out, rest = list[int](), 0, b""
    with paused_terminal() as paused, outputs_in_threads():
        for number in range(LINES):
            show(f"line {number}")
        termios.tcflow(sys.stdout.fileno(), termios.TCOON)
        while len(numbers) + left_out < LINES:
            *lines, rest = (rest + os.read(paused, 1 << 16)).split(b"\r\n")
            for first, second in (line.decode().split()[:2] for line in lines):
                if first == "line":
                    numbers.append(int(second))
                else:
                    left_out += int(first)
    assert numbers == sorted(set(numbers))
    assert left_out > 0


def test_a_paused_terminal_gets_few_pictures_and_the_last_one() -> None:
    """Failed before: who drew the first one waited until somebody read it."""
    now_s = 0.0
    with paused_terminal() as paused, outputs_in_threads():
        with ProgressDisplay("part", clock_s=lambda: now_s, is_behind=is_behind) as display:
            for done in range(LINES):
                now_s += 1.0
                display.update(Progress(done=done, total=LINES, unit="lines"))
        termios.tcflow(sys.stdout.fileno(), termios.TCOON)
        seen = b""
        while not seen.endswith(b"\x1b[?25h"):  # the cursor is shown again
            seen += os.read(paused, 1 << 16)
    pictures = seen.count(b"part: ")
    assert pictures < 10
    assert f"{LINES - 1:,}/{LINES:,} lines".encode() in seen


def test_a_demo_goes_on_and_reports_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Failed before: what it prints while it moves ended it."""
    proved: list[Progress] = []

    def print_and_prove(_hardware: object, _program: object, _host: object, on_progress: OnProgress) -> None:
        show("while it moves")
        on_progress(progress := Progress(done=1, total=2))
        proved.append(progress)

    monkeypatch.setattr(demo, "print_and_prove", print_and_prove)
    monkeypatch.setattr(demo, "VirtualMachine", lambda *_: nullcontext())
    with full_disk(), pytest.raises(OutputError):
        run_demo(DemoOptions(keep=tmp_path))
    assert proved

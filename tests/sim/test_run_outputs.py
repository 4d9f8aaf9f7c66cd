"""``canductor run`` whose output is full, closed, or read by nobody: it prints on; in virtual time."""

import os
import threading
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import pytest

from coordinator.cli.commands import run
from coordinator.cli.main import EXIT_BROKEN_PIPE, EXIT_FAILED, main
from coordinator.support.interrupts import run_to_end
from tests.stages.demo_machine import SQUARE, DemoMachine

REPLIES = 1000
REPLY = "x" * 100
"""All of them are more than a pipe holds."""
TALKATIVE = SQUARE + f"M118 {REPLY}\n" * REPLIES + "G1 X5\n"


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep what commands cache out of the user's home."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def machine(tmp_path: Path) -> DemoMachine:
    return DemoMachine(tmp_path)


@pytest.fixture
def over(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Return what is set when the print is over, whatever waits to be read then."""
    event = threading.Event()

    def run_and_set(job: Callable[[], Coroutine[Any, Any, Any]], *rest: Any) -> Any:
        try:
            return run_to_end(job, *rest)
        finally:
            event.set()

    monkeypatch.setattr(run, "run_to_end", run_and_set)
    return event


@contextmanager
def output_to_pipe() -> Iterator[int]:
    """Make standard output a pipe, and yield its other end; who writes to it directly does not wait."""
    reads, writes = os.pipe()
    os.set_blocking(writes, False)
    with os.fdopen(writes, "w", encoding="utf-8") as stream, redirect_stdout(stream):
        yield reads


def stands_at_5(machine: DemoMachine) -> bool:
    """Whether the last line was carried out, and no node was stopped."""
    rising = sum(level for _, level in machine.edges("PB0", "mcu"))
    return machine.shut_down == set() and rising == 20_000


def test_a_full_disk(machine: DemoMachine, capfd: pytest.CaptureFixture[str]) -> None:
    """Failed before: the first reply stopped all nodes."""
    with Path("/dev/full").open("w", encoding="utf-8") as stream, redirect_stdout(stream):
        assert main(["run"], lambda _: lambda: machine.print(TALKATIVE)) == EXIT_FAILED
    assert capfd.readouterr().err == "canductor: cannot write the output: no space left on device\n"
    assert stands_at_5(machine)


def test_a_reader_that_is_gone(machine: DemoMachine, capfd: pytest.CaptureFixture[str]) -> None:
    """Failed before, as with ``| head``."""
    with output_to_pipe() as reads:
        os.close(reads)
        assert main(["run"], lambda _: lambda: machine.print(TALKATIVE)) == EXIT_BROKEN_PIPE
    assert capfd.readouterr().err == ""
    assert stands_at_5(machine)


def test_a_reader_that_waits(machine: DemoMachine, over: threading.Event) -> None:
    """Failed before: where it does not fail, the loop waited, and the nodes shut down."""
    seen = b""

    def read() -> None:
        nonlocal seen
        over.wait()
        while piece := os.read(reads, 1 << 16):
            seen += piece

    reader = threading.Thread(target=read, daemon=True)
    with output_to_pipe() as reads:
        reader.start()
        assert main(["run"], lambda _: lambda: machine.print(TALKATIVE)) == 0
    reader.join()
    os.close(reads)
    assert seen.decode().splitlines().count(f"echo: {REPLY}") == REPLIES
    assert stands_at_5(machine)

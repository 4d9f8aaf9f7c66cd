"""Who waits for a processor is seen."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.soak.waiting import command_of, family, waited_s

READS = [sys.executable, "-c", "input()"]


def test_a_family_is_the_process_and_those_below_it() -> None:
    with subprocess.Popen(READS, stdin=subprocess.PIPE) as child:
        assert {os.getpid(), child.pid} <= set(family(os.getpid()))
        assert family(child.pid) == [child.pid]
        assert command_of(child.pid).endswith(f" ({child.pid})")
        child.kill()
    assert command_of(child.pid) == f"({child.pid}, ended)"
    assert waited_s(child.pid) == 0.0


def test_the_waits_of_all_threads_are_added(tmp_path: Path) -> None:
    for task, waited_ns in (("7", 2_000_000_000), ("8", 500_000_000)):
        folder = tmp_path / "7" / "task" / task
        folder.mkdir(parents=True)
        (folder / "schedstat").write_text(f"70867292 {waited_ns} 332\n")
    assert waited_s(7, tmp_path) == pytest.approx(2.5)

"""What a standstill of the computer does to tests that fail, in a pytest of its own."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.standstill import LOOK_S, STILL_S, TRIES, Watcher, kernel_stolen_s

ROOT = Path(__file__).parents[1]
CONFTEST = """
import pytest
from tests.standstill import Repeating, Watcher
watcher = Watcher(stolen_s=lambda: 0.0)
def pytest_configure(config):
    config.pluginmanager.register(Repeating(watcher))
@pytest.fixture
def still():
    watcher.longest_s = 9.0
"""
TESTS = """
import pytest
tries = []
@pytest.fixture(scope="module")
def shared():
    made = []
    yield made
    tries.append(len(made))
def test_before(shared):
    shared.append(1)
def test_passes_in_the_end(shared, still):
    shared.append(2)
    assert len(tries) == 2
def test_never_passes(still):
    tries.append("n")
    assert 0, f"fails {tries.count('n')}"
def test_fails_without_standstill():
    tries.append("w")
    assert 0, f"fails {tries.count('w')}"
"""


def play(folder: Path, *words: str) -> str:
    (folder / "conftest.py").write_text(CONFTEST)
    (folder / "test_it.py").write_text(TESTS)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *words, str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize("words", [[], ["-n", "1"]])
def test_what_failed_in_a_standstill_is_begun_anew(tmp_path: Path, words: list[str]) -> None:
    said = play(tmp_path, *words)
    assert "2 failed, 2 passed, 4 repeated" in said
    assert said.count("test_passes_in_the_end: the computer stood still for 9.0 s; ") == 2
    assert said.count("test_never_passes: the computer stood still for 9.0 s; ") == TRIES - 1
    assert f"fails {TRIES}" in said
    assert "without_standstill: the computer" not in said
    assert "fails 1" in said.split("test_fails_without_standstill", 1)[1]


def test_the_longest_standstill_counts() -> None:
    now_s = 0.0
    watcher = Watcher(lambda: now_s, lambda: 0.0)
    for wait_s in (LOOK_S, LOOK_S + 2 * STILL_S, LOOK_S, LOOK_S + STILL_S):
        now_s += wait_s
        watcher.look()
    assert watcher.still_s() == pytest.approx(2 * STILL_S)
    watcher.begin()
    assert watcher.still_s() == 0


def test_stolen_time_counts() -> None:
    stolen_s = 5.0
    watcher = Watcher(lambda: 0.0, lambda: stolen_s)
    assert watcher.still_s() == 0
    stolen_s = 5.5
    assert watcher.still_s() == 0.5
    watcher.begin()
    assert watcher.still_s() == 0


def test_the_kernel_tells_what_was_stolen() -> None:
    assert 0 <= kernel_stolen_s() <= time.clock_gettime(time.CLOCK_BOOTTIME) * (os.cpu_count() or 1)

"""[idle_timeout] whose g-code does not get its turn; the rest is in tests/sim/test_idle_timeout.py."""

from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from coordinator.modules.heaters.heaters import HeaterRegistry
from coordinator.modules.programs.idle_timeout import STUCK_S, IdleTimeout
from tests.stages.heat_machine import BED, HOTEND_PID, build


class HeldRunner:
    """Keeps what it is to run, as while the machine waits for a node that is missing."""

    busy = paused = False
    moved = 0

    def __init__(self) -> None:
        self.waiting: list[list[str]] = []

    def run_lines(
        self, name: str, lines: Sequence[str], text: str = "", *, on_end: Callable[[], None] = lambda: None
    ) -> None:
        del name, text, on_end
        self.waiting.append([*lines])


def test_heaters_do_not_wait_for_g_code_that_never_begins(tmp_path: Path) -> None:
    modules = build(tmp_path, HOTEND_PID + BED)
    idle, heaters = next(modules.of(IdleTimeout)), next(modules.of(HeaterRegistry))
    runner, said, now_s = HeldRunner(), list[str](), 0.0
    live: Any = SimpleNamespace(now_s=lambda: now_s, machine=SimpleNamespace(runner=runner), say=said.append)
    idle._live, idle._state = live, "Ready"
    heaters.units["heater_bed"].set_target(60.0)
    while heaters.targets:
        now_s += 1.0
        idle.look()
    assert now_s == 1 + 600 + STUCK_S
    assert runner.waiting == [["_IDLE_TIMEOUT"], ["M84"]]
    assert said[1:] == ["[idle_timeout]: its g-code does not get its turn: TURN_OFF_HEATERS and M84"]

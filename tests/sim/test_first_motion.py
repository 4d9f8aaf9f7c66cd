"""How soon the machine moves after a G1, on a bus of its own and beside other traffic."""

import asyncio
from pathlib import Path

import pytest

from coordinator.gcode.program import Program
from coordinator.service.core.job_runner import run_job
from coordinator.simulate import scenario as scenarios
from coordinator.simulate.stage import Stage

NS = 1_000_000_000


class Typed:
    """Someone who types a G28 at once and a G1 three seconds later."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._pieces = [b"G28\n", b"G1 X30 F6000\n"]
        self._since_ns = 0
        self.moved_ns: int | None = None
        """True time at which the G1 was read."""

    def read(self, _: int, /) -> bytes | None:
        now = self._stage.now_ns()
        if len(self._pieces) == 2:
            self._since_ns = now
        elif self._pieces and now < self._since_ns + 3 * NS:
            return None
        elif self._pieces:
            self.moved_ns = now
        return self._pieces.pop(0) if self._pieces else b""

    def close(self) -> None:
        pass


def first_step_s(folder: Path, load: float) -> float:
    """Return the seconds of true time from reading the G1 to the first change of a step pin."""
    text = f'about = "First."\nmachine = "quad"\n[buses.can0]\nload = {load}\nload_id = 260\n'
    (folder / "first.toml").write_text(text)
    stage = Stage(scenarios.find(str(folder / "first.toml")), 1)
    typed = Typed(stage)
    with asyncio.Runner(loop_factory=stage.make_loop) as runner:
        job = run_job(
            stage.description,
            Program(typed, "typed"),
            on_output=lambda _: None,
            host=stage.host,
        )
        runner.run(job)
    assert typed.moved_ns is not None
    firsts = []
    for stepper in stage.description.steppers:
        truth, pin = stage.board(stepper.node), stage.pins(stepper.node)[stepper.step_pin.name]
        steps = truth.at_ns[(truth.pin == pin) & (truth.at_ns > typed.moved_ns)]
        firsts += [int(steps[0])] if len(steps) else []
    return (min(firsts) - typed.moved_ns) / NS


def test_the_first_step_comes_within_300_ms(tmp_path: Path) -> None:
    assert 0.1 < first_step_s(tmp_path, 0.0) < 0.3


def test_on_a_busy_bus_it_waits_until_the_commands_are_there(tmp_path: Path) -> None:
    assert first_step_s(tmp_path, 0.5) == pytest.approx(0.6, abs=0.06)

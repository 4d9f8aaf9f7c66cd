"""What SET_STEPPER_CARRIAGES refuses; what it does is in sim/test_live_machine_changes.py."""

from pathlib import Path

import pytest

from coordinator.support.examples import EXAMPLES
from tests.stages.program_stage import ProgramStage


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> ProgramStage:
    text = Path(EXAMPLES / "generic_cartesian.cfg").read_text(encoding="utf-8")
    return ProgramStage(tmp_path_factory.mktemp("machine"), "[skew_correction]\n", text)


@pytest.mark.parametrize(
    ("line", "part_of"),
    [
        ("SET_STEPPER_CARRIAGES STEPPER=belt CARRIAGES=x", "there is no 'belt'"),
        ("SET_STEPPER_CARRIAGES STEPPER=screw", "has no CARRIAGES"),
        ("SET_STEPPER_CARRIAGES STEPPER=screw CARRIAGES=z*2", "give a sum of different carriages"),
        ("SET_STEPPER_CARRIAGES STEPPER=screw CARRIAGES=z+x", "screw moves z, of which only factors"),
    ],
)
def test_mistakes(machine: ProgramStage, line: str, part_of: str) -> None:
    assert part_of in machine.error("G28", line)


def test_motors_that_do_not_determine_the_place_are_refused(machine: ProgramStage) -> None:
    swap = "SET_STEPPER_CARRIAGES STEPPER={} CARRIAGES=x+y"
    assert machine.run("G28", swap.format("belt_b"), swap.format("belt_a1")) == []
    assert "x, y and z independently" in machine.error(swap.format("belt_b1"))
    assert machine.run(f"{swap.format('belt_b1')} DISABLE_CHECKS=1") == []
    assert machine.run("SET_STEPPER_CARRIAGES STEPPER=belt_b CARRIAGES=x-y") == []


def test_skew_is_cleared_first(machine: ProgramStage) -> None:
    machine.run("G28", "SET_SKEW XY=100,101,70")
    assert "SET_SKEW CLEAR=1 first" in machine.error("SET_STEPPER_CARRIAGES STEPPER=screw CARRIAGES=2*z")
    machine.run("SET_SKEW CLEAR=1", "SET_STEPPER_CARRIAGES STEPPER=screw CARRIAGES=2*z")

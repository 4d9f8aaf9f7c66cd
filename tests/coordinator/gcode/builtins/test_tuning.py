"""TUNING_TOWER: which value comes before which move; that it acts is in sim/test_live_machine_changes.py."""

import pytest

from coordinator.gcode.errors import GCodeError
from coordinator.gcode.events import End, Full, Notice, Reply
from coordinator.gcode.interpreter import Job
from coordinator.gcode.program import Program
from coordinator.gcode.tuning_tower import TuningTower
from coordinator.motion.planner.planner import Planner
from tests.coordinator.motion.planner_helpers import LIMITS, drain

HOME = {"X": 0.0, "Y": 0.0, "Z": 0.0}


def run(*lines: str) -> list[str]:
    """Run LINES; return what is said."""
    job = Job(Program.from_lines(lines, "part.gcode"), Planner(LIMITS), HOME)
    said: list[str] = []
    while not isinstance(event := job.step(), End):
        drain(job.planner)
        if isinstance(event, Reply | Notice):
            said.append(event.text)
        assert not isinstance(event, Full) or job.planner.moves
    return said[1:]  # without that of G28


@pytest.mark.parametrize(
    ("tower", "values"),
    [
        (TuningTower("M118", "V", 5, factor=2), {0: 5, 0.3: 5.6, 10: 25}),
        (TuningTower("M118", "V", 5, factor=2, skip_mm=1), {0.9: 5, 1: 5, 3: 9}),
        (
            TuningTower("M118", "V", 5, factor=2, band_mm=0.2, skip_mm=1),
            {0.9: 5, 1: 5.2, 1.6: 6.4, 1.61: 6.4},
        ),
        (TuningTower("M118", "V", 260, step=-5, step_height_mm=0.2), {0: 260, 0.59: 250, 0.6: 245}),
    ],
)
def test_the_value_of_a_height(tower: TuningTower, values: dict[float, float]) -> None:
    assert {z: tower.value_at(z) for z in values} == pytest.approx(values)


def test_it_comes_before_what_prints_at_another_height_and_counts_as_no_line() -> None:
    said = run(
        "G28", "M83", "TUNING_TOWER COMMAND=M118 PARAMETER=v START=5 STEP_DELTA=1 STEP_HEIGHT=0.5",
        "G1 X5 E1 F6000", "G1 Z0.4 E0.1", "G1 X10 E1", "G1 Z1.1", "G1 X20", "G1 E0.5", "G2 X30 I5 Z1.3 E1",
        "G1 X31 E1", "M204 S99999", "G1 Z0.1", "G1 X40 E1", "G1 Z5", "G1 X50 E1", "G1 Z2.9", "G1 X60 E1",
        "G1 Z9", "G1 X70 E1",
    )  # fmt: skip
    assert said == [
        "TUNING_TOWER begins: M118 V5.000000000",
        "echo: V5.000000000",
        "echo: V7.000000000",
        "part.gcode:12: the acceleration 99999 is above the configured 10000: 10000 is used",
        "echo: V5.000000000",
        "echo: V15.000000000",
        "TUNING_TOWER ends: another print begins",
    ]


def test_its_own_error_names_it() -> None:
    with pytest.raises(GCodeError, match=r"part\.gcode:4: TUNING_TOWER:1: S of M220 is -5 %"):
        run("G28", "M83", "TUNING_TOWER COMMAND=M220 PARAMETER=S START=-5", "G1 X5 E1 F6000")


@pytest.mark.parametrize(
    ("words", "part_of"),
    [
        ("", "has no COMMAND"),
        ("COMMAND=M118", "has no PARAMETER"),
        ("COMMAND=M118 PARAMETER=1", "such as SET_PRESSURE_ADVANCE"),
        ("COMMAND=NIX PARAMETER=V", "'NIX', which is no command"),
        ("COMMAND=M118 PARAMETER=V STEP_DELTA=1 STEP_HEIGHT=1e-320", "needs both STEP_DELTA and STEP_HEIGHT"),
        ("COMMAND=M118 PARAMETER=V STEP_DELTA=1", "needs both STEP_DELTA and STEP_HEIGHT"),
        ("COMMAND=M118 PARAMETER=V STEP_DELTA=1 STEP_HEIGHT=1 FACTOR=1", "leave two"),
        ("COMMAND=M118 PARAMETER=V FACTOR=x", "'x', which is not a number"),
    ],
)
def test_mistakes(words: str, part_of: str) -> None:
    with pytest.raises(GCodeError) as error:
        run("G28", f"TUNING_TOWER {words}")
    assert part_of in str(error.value)

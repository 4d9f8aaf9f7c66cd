"""Offsets, saved states and frames: where the moves of a program lead to."""

from pathlib import Path

import pytest

from coordinator.gcode.builtins.state import SAVED_MAX
from coordinator.gcode.errors import GCodeError
from tests.stages.program_stage import ProgramStage


@pytest.fixture
def machine(tmp_path: Path) -> ProgramStage:
    return ProgramStage(tmp_path)


def at(machine: ProgramStage) -> tuple[float, ...]:
    return tuple(round(value, 9) for value in machine.planner.toolhead_position)


def test_an_offset_shifts_what_follows(machine: ProgramStage) -> None:
    machine.run("G28", "G1 X10 Y10 Z10 F6000", "SET_GCODE_OFFSET Z=0.2 X_ADJUST=1", "G1 Y20")
    assert at(machine) == (10, 20, 10, 0)  # nothing moves by itself
    machine.run("G1 X10 Z10")
    assert at(machine) == (11, 20, 10.2, 0)
    assert machine.run("M114") == ["X:10.000 Y:20.000 Z:10.000 E:0.000"]
    machine.run("SET_GCODE_OFFSET Z_ADJUST=-0.1 MOVE=1 MOVE_SPEED=5")
    assert at(machine) == (11, 20, 10.1, 0)
    assert machine.run("M114", "GET_POSITION") == [
        "X:10.000 Y:20.000 Z:10.000 E:0.000",
        "toolhead: X:11.000000 Y:20.000000 Z:10.100000 E:0.000000",
        "gcode: X:10.000000 Y:20.000000 Z:10.000000 E:0.000000",
        "gcode base: X:1.000000 Y:0.000000 Z:0.100000 E:0.000000",
        "gcode homing: X:1.000000 Y:0.000000 Z:0.100000",
    ]


def test_homing_keeps_an_offset_and_takes_an_origin_away(machine: ProgramStage) -> None:
    machine.run("SET_GCODE_OFFSET Z=0.5", "G28", "G92 Z7", "G28", "G1 Z5 F600")
    assert at(machine)[2] == 5.5


def test_babysteps_beside_a_job_need_no_move_of_their_own(machine: ProgramStage) -> None:
    machine.run("G28", "G1 X10 Y10 Z10 F6000")
    job = machine.job("SET_GCODE_OFFSET Z_ADJUST=0.05 MOVE=1")
    job.while_printing = True
    moves = machine.planner.moves
    while type(job.step()).__name__ != "End":
        pass
    assert machine.planner.moves == moves
    machine.run("G1 X20")
    assert machine.planner.moves == moves + 1
    assert at(machine) == (20, 10, 10.05, 0)
    machine.run("G91", "G1 X1", "G90", "G1 Z10")
    assert at(machine) == (21, 10, 10.05, 0)


def test_a_babystep_out_of_the_machine_is_refused_before_it_harms_the_job(machine: ProgramStage) -> None:
    machine.run("G28", "G1 X10 F6000")
    job = machine.job("SET_GCODE_OFFSET Z_ADJUST=-0.05 MOVE=1")
    job.while_printing = True
    with pytest.raises(GCodeError, match="outside 0 to 220 mm; choose a smaller one"):
        [job.step() for _ in range(9)]
    machine.run("G1 X20")
    assert at(machine) == (20, 0, 0, 0)
    assert machine.planner.gcode_offset == (0, 0, 0, 0)


def test_a_saved_state_comes_back_whole(machine: ProgramStage) -> None:
    machine.run("G28", "G1 X10 Y10 Z10 F6000", "G1 E5", "G92 X0 E0", "M220 S50", "SET_GCODE_OFFSET Z=1")
    machine.run("SAVE_GCODE_STATE NAME=there")
    reads = machine.run("M114")
    machine.run(
        "G91", "M83", "G20", "G1 X1 E0.1 F60", "M220 S200", "M221 S150", "G92 X7", "SET_GCODE_OFFSET Z=3"
    )
    machine.run("RESTORE_GCODE_STATE NAME=there")
    planner = machine.planner
    assert (planner.relative, planner.relative_extrusion, planner.unit_mm) == (False, False, 1.0)
    assert (planner.speed_mm_s, planner.speed_factor, planner.extrude_factor) == (100.0, 0.5, 1.0)
    assert planner.gcode_offset == (0, 0, 1, 0)
    assert at(machine) == (35.4, 10, 10, 5 + 2.54)
    machine.run("RESTORE_GCODE_STATE NAME=there MOVE=1 MOVE_SPEED=20")
    assert at(machine) == (10, 10, 10, 7.54)
    assert machine.run("M114") == reads  # also of E, wherever the filament is


@pytest.mark.parametrize(
    ("line", "part"),
    [
        ("RESTORE_GCODE_STATE NAME=x", "names the state 'x', which is not saved; none is saved"),
        ("SET_GCODE_OFFSET Z=abc", "not a number"),
        ("SET_GCODE_OFFSET Z=1e9", "the offset is 1000000000.0"),
        ("SET_GCODE_OFFSET Z=1 MOVE=2", "give 0 or 1"),
        ("SET_GCODE_OFFSET Z=-1 MOVE=1", "outside 0 to 220 mm"),
        ("SET_GCODE_OFFSET Z=1 MOVE=1 MOVE_SPEED=0", "must be above 0"),
    ],
)
def test_mistakes(machine: ProgramStage, line: str, part: str) -> None:
    with pytest.raises(GCodeError) as error:
        machine.run("G28", line)
    assert part in str(error.value)
    assert machine.planner.gcode_offset[2] == 0


def test_a_state_that_is_not_saved_is_told_with_those_that_are(machine: ProgramStage) -> None:
    with pytest.raises(GCodeError) as error:
        machine.run("SAVE_GCODE_STATE NAME=A", "SAVE_GCODE_STATE NAME=b", "RESTORE_GCODE_STATE")
    assert str(error.value).endswith("names the state 'default', which is not saved; there is A, b")


def test_states_are_bounded(machine: ProgramStage) -> None:
    machine.run(*(f"SAVE_GCODE_STATE NAME=s{n}" for n in range(SAVED_MAX)), "SAVE_GCODE_STATE NAME=s0")
    with pytest.raises(GCodeError, match="100 states"):
        machine.run("SAVE_GCODE_STATE NAME=more")

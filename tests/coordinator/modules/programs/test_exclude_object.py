"""Objects that are left out: their moves are not made, and the filament is where the next one expects it."""

from pathlib import Path
from typing import Any

import pytest

from coordinator.gcode.errors import GCodeError
from coordinator.modules.programs.exclude_object import ALL_POINTS_MAX
from tests.stages.program_stage import ProgramStage

DEFINED = (
    "EXCLUDE_OBJECT_DEFINE NAME=a CENTER=10,20 POLYGON=[[0,0],[20,0],[20,40]]",
    "EXCLUDE_OBJECT_DEFINE NAME=b",
)
BEGIN = ("G28", "G90", "M82", "G92 E0", "G1 Z1 F600", "G1 X5 Y5 E1 F6000", "G1 E0.2 F1800")


def part(name: str, x: float, first_e: float) -> list[str]:
    """An object as slicers write it: retracted before and after."""
    return [
        f"EXCLUDE_OBJECT_START NAME={name}",
        f"G1 X{x} Y50 F6000",
        f"G1 E{first_e} F1800",
        f"G1 X{x + 5} E{first_e + 0.5}",
        f"G1 X{x + 10} E{first_e + 1}",
        f"G1 E{first_e + 0.2} F1800",
        f"EXCLUDE_OBJECT_END NAME={name}",
    ]


@pytest.fixture
def machine(tmp_path: Path) -> ProgramStage:
    return ProgramStage(tmp_path, "[exclude_object]\n[gcode_arcs]\n")


def at(machine: ProgramStage) -> tuple[float, ...]:
    return tuple(round(value, 9) for value in machine.planner.toolhead_position)


def test_objects_are_known(machine: ProgramStage) -> None:
    machine.run(*BEGIN, *DEFINED, "EXCLUDE_OBJECT_START NAME=a", "EXCLUDE_OBJECT NAME=B")
    assert machine.modules.status()["exclude_object"] == {
        "objects": [
            {"name": "A", "center": [10.0, 20.0], "polygon": [[0.0, 0.0], [20.0, 0.0], [20.0, 40.0]]},
            {"name": "B"},
        ],
        "excluded_objects": ["B"],
        "current_object": "A",
    }
    assert machine.run(
        "EXCLUDE_OBJECT_DEFINE", "EXCLUDE_OBJECT", "EXCLUDE_OBJECT RESET=1", "EXCLUDE_OBJECT"
    ) == [
        "Known objects: A B",
        "Excluded objects: B",
        "Excluded objects: none",
    ]
    machine.run("EXCLUDE_OBJECT_DEFINE RESET=1")
    assert machine.modules.status()["exclude_object"]["objects"] == []


def test_points_of_all_objects_are_bounded_and_made_once(machine: ProgramStage) -> None:
    """Failed before: 540,000 of them, and all were made again at each look at the status."""
    zigzag = ",".join(f"[{number % 7},{number}]" for number in range(400))
    machine.run(*(f"EXCLUDE_OBJECT_DEFINE NAME=o{number} POLYGON=[{zigzag}]" for number in range(100)))
    objects = shown(machine)
    assert len(objects) == 100
    assert objects[24]["polygon"][1] == [1.0, 1.0]
    assert objects[25]["polygon"] == [[0.0, 0.0], [6.0, 0.0], [6.0, 399.0], [0.0, 399.0]]
    assert sum(len(found["polygon"]) for found in objects) == ALL_POINTS_MAX + 75 * 4
    assert all(again is found for again, found in zip(shown(machine), objects, strict=True))
    machine.run(
        "EXCLUDE_OBJECT_DEFINE NAME=o0 CENTER=1,1", f"EXCLUDE_OBJECT_DEFINE NAME=o0 POLYGON=[{zigzag}]"
    )
    assert len(shown(machine)[0]["polygon"]) == 4, "those of others count"
    machine.run("EXCLUDE_OBJECT_DEFINE RESET=1", f"EXCLUDE_OBJECT_DEFINE NAME=o0 POLYGON=[{zigzag}]")
    assert len(shown(machine)[0]["polygon"]) == 400
    assert "512 at most" in machine.error("EXCLUDE_OBJECT_DEFINE NAME=" + "n" * 513)


def shown(machine: ProgramStage) -> list[Any]:
    objects = machine.modules.status()["exclude_object"]["objects"]
    assert isinstance(objects, list)
    return objects


def test_moves_of_an_excluded_object_are_left_out(machine: ProgramStage) -> None:
    machine.run(*BEGIN, *DEFINED, "EXCLUDE_OBJECT NAME=a", *part("a", 100, 1.0))
    assert at(machine) == (5, 5, 1, 0.2)
    assert machine.run("M114") == ["X:110.000 Y:50.000 Z:1.000 E:1.200"]
    machine.run("G1 X150", "G1 E2")  # unretracts by 0.8, as it would have
    assert at(machine) == (150, 50, 1, 1.0)


def test_all_others_get_what_they_would_have_got(machine: ProgramStage, tmp_path: Path) -> None:
    program = [*BEGIN, *DEFINED, *part("a", 100, 1.0), *part("b", 130, 2.0), *part("c", 160, 3.0)]
    whole = ProgramStage(tmp_path, "[exclude_object]\n")
    whole.run(*program)
    machine.run(*program[: len(BEGIN) + 2], "EXCLUDE_OBJECT NAME=b", *program[len(BEGIN) + 2 :])
    assert at(machine)[:3] == at(whole)[:3]
    assert at(machine)[3] == pytest.approx(at(whole)[3] - 1.0)
    assert machine.planner.retracted_mm == pytest.approx(0.8)
    xs = [move[0] for move in machine.moves]
    assert any(100 <= x < 115 for x in xs)
    assert not any(130 <= x < 145 for x in xs)
    assert any(160 <= x < 175 for x in xs)


@pytest.mark.parametrize("line", range(1, 6))
def test_an_object_may_be_left_out_at_any_of_its_lines(machine: ProgramStage, line: int) -> None:
    lines = part("a", 100, 1.0)
    machine.run(*BEGIN, *DEFINED, *lines[:line], "EXCLUDE_OBJECT CURRENT=1", *lines[line:])
    # Drawn back by as much as the program believes, whatever it was in the middle.
    assert machine.planner.retracted_mm == pytest.approx(0.8)
    top = machine.planner.filament_mm
    assert at(machine)[3] == pytest.approx(top - 0.8)
    stood = at(machine)
    machine.run("G1 E2", "M114")
    assert at(machine)[3] == pytest.approx(stood[3] + 0.8)


def test_arcs_and_relative_moves_are_left_out_too(machine: ProgramStage) -> None:
    machine.run(
        *BEGIN, "M83", *DEFINED, "EXCLUDE_OBJECT NAME=a", "EXCLUDE_OBJECT_START NAME=a", "G1 E0.8 F1800",
        "G2 X25 I10 E3", "G91", "G1 X10 E1", "G90", "EXCLUDE_OBJECT_END NAME=a", "G1 Y60 E0.5 F6000",
    )  # fmt: skip
    assert at(machine) == (35, 60, 1, 1.5)  # 0.2, unretracted by 0.8, and 0.5


def test_a_new_origin_within_an_excluded_object_counts(machine: ProgramStage) -> None:
    lines = part("a", 100, 1.0)
    machine.run(
        *BEGIN, *DEFINED, "EXCLUDE_OBJECT NAME=a", *lines[:4], "G92 X0 E0", "G1 X7 Z1.2 E0.5",
        "G1 E-0.3 F1800", lines[-1], "M114",
    )  # fmt: skip
    assert at(machine) == (5, 5, 1, 0.2), "drawn back by 0.8 it was, and is to be"
    machine.run("G1 X20 Y60 F6000", "G1 E0.5 F1800")
    assert at(machine) == pytest.approx((125, 60, 1.2, 1.0)), "X 105 was named 0; Z is the program's"


def test_the_begin_of_an_object_ends_the_one_before(machine: ProgramStage) -> None:
    said = machine.notices(
        *BEGIN, *DEFINED, "EXCLUDE_OBJECT NAME=a", "EXCLUDE_OBJECT_START NAME=a", "G1 X50 E1.5",
        "EXCLUDE_OBJECT_START NAME=b", "EXCLUDE_OBJECT_END NAME=a", "G1 X60 E2", "EXCLUDE_OBJECT_END NAME=b",
        "EXCLUDE_OBJECT_END",
    )  # fmt: skip
    assert at(machine)[0] == 60
    assert [line.partition(": ")[2] for line in said[-2:]] == [
        "EXCLUDE_OBJECT_END A: it is B: the line is ignored",
        "EXCLUDE_OBJECT_END: no object is being printed: the line is ignored",
    ]
    assert machine.run("EXCLUDE_OBJECT_DEFINE JSON=1")[0] == (
        'Known objects: [{"name": "A", "center": [10.0, 20.0], "polygon": [[0.0, 0.0], [20.0, 0.0],'
        ' [20.0, 40.0]]}, {"name": "B"}]'
    )


def test_taking_it_back_goes_on_with_the_object(machine: ProgramStage) -> None:
    lines = part("a", 100, 1.0)
    machine.run(
        *BEGIN, *DEFINED, *lines[:3], "EXCLUDE_OBJECT CURRENT=1", lines[3], "EXCLUDE_OBJECT RESET=1 NAME=a"
    )
    machine.run(*lines[4:])
    assert at(machine) == pytest.approx((110, 50, 1, 1.0 + 0.5 - 0.8))


def test_a_program_that_ends_in_the_middle_leaves_nothing_out_of_the_next(machine: ProgramStage) -> None:
    machine.run(*BEGIN, *DEFINED, "EXCLUDE_OBJECT NAME=a", *part("a", 100, 1.0)[:4])
    assert machine.planner.excluded
    machine.planner.reset_modes()
    machine.run("G1 X50 F6000")
    assert at(machine) == (50, 5, 1, 0.2)
    machine.run("EXCLUDE_OBJECT_START NAME=b", "EXCLUDE_OBJECT_END NAME=b", "G1 X60")
    assert at(machine) == (60, 5, 1, 0.2)


@pytest.mark.parametrize(
    ("line", "part_of"),
    [
        ("EXCLUDE_OBJECT NAME=c", "no object of this program; there is A, B"),
        ("EXCLUDE_OBJECT CURRENT=1", "where no object is"),
        ("EXCLUDE_OBJECT_START", "has no NAME"),
        ("EXCLUDE_OBJECT_DEFINE NAME=d CENTER=1", "has 1 numbers"),
        ("EXCLUDE_OBJECT_DEFINE NAME=d POLYGON=[[1,2", "write [[x,y]"),
        ("EXCLUDE_OBJECT_DEFINE NAME=d POLYGON=[[1,2,3]]", "has 3 numbers"),
        ("EXCLUDE_OBJECT_DEFINE NAME=d POLYGON=" + "[" * 3000, "write [[x,y]"),
    ],
)
def test_mistakes(machine: ProgramStage, line: str, part_of: str) -> None:
    with pytest.raises(GCodeError) as error:
        machine.run(*DEFINED, line)
    assert part_of in str(error.value)

"""M17, M18, SET_STEPPER_ENABLE, STEPPER_BUZZ: judged by the enable pins and the steps that were made."""

from pathlib import Path

import pytest

from coordinator.gcode.errors import GCodeError
from tests.stages.printer_text import SWITCHES_CFG
from tests.stages.program_stage import ProgramStage
from tests.stages.switch_printer import SwitchPrinter

ENABLE = {"x": "PC0", "y": "PC1", "z": "PC2"}
STEP = {"x": "PB0", "y": "PB3", "z": "PB6"}


def with_enable_pins() -> str:
    text = SWITCHES_CFG
    for axis, direction in (("x", "PB1"), ("y", "!PB4"), ("z", "PB7")):
        text = text.replace(f"dir_pin: {direction}\n", f"dir_pin: {direction}\nenable_pin: !{ENABLE[axis]}\n")
    return text


def printer(folder: Path) -> SwitchPrinter:
    return SwitchPrinter(folder, {"x": -20.0, "y": 15.0, "z": -4.0}, machine=with_enable_pins())


def switched(found: SwitchPrinter, axis: str) -> list[tuple[int, bool]]:
    """Return when a driver was switched, and whether on; its pin is low then. The first is that at start."""
    edges = found.stage.edges("mcu")
    own = edges[edges["pin"] == found.stage.pins("mcu")[ENABLE[axis]]]
    return [(int(at), not level) for at, level in zip(own["true_ps"], own["level"], strict=True)][1:]


def steps(found: SwitchPrinter, axis: str) -> list[int]:
    edges = found.stage.edges("mcu")
    own = edges[(edges["pin"] == found.stage.pins("mcu")[STEP[axis]]) & (edges["level"] == 1)]
    return [int(at) for at in own["true_ps"]]


def levels(found: SwitchPrinter, axis: str) -> list[bool]:
    return [on for _, on in switched(found, axis)]


def test_a_driver_is_switched_on_before_its_own_motor_moves_and_all_by_m17(tmp_path: Path) -> None:
    found = printer(tmp_path)
    found.run("G28 X", "G28 Y", "G1 X30 Y200 F6000", "M17", "M18")
    for axis in "xyz":
        assert levels(found, axis) == [True, False], axis
    (on_x, off_x), (on_y, _), (on_z, _) = ([at for at, _ in switched(found, axis)] for axis in "xyz")
    assert on_x < steps(found, "x")[0] < on_y < steps(found, "y")[0]
    assert max(steps(found, "x")[-1], steps(found, "y")[-1]) < on_z < off_x
    assert not steps(found, "z")


def test_one_driver_is_switched_and_its_axis_is_not_known_any_more(tmp_path: Path) -> None:
    found = printer(tmp_path)
    with pytest.raises(GCodeError, match=r"^part\.gcode:5: X is to move before it is homed"):
        found.run(
            "G28",
            "SET_STEPPER_ENABLE STEPPER=stepper_x ENABLE=0",
            "SET_STEPPER_ENABLE STEPPER=stepper_x ENABLE=1",
            "G1 Y190 F6000",
            "G1 X5",
        )
    assert levels(found, "x") == [True, False, True]
    assert levels(found, "y") == [True]


def test_a_driver_that_was_switched_off_stays_so_while_others_move(tmp_path: Path) -> None:
    found = printer(tmp_path)
    found.run("G28", "SET_STEPPER_ENABLE STEPPER=stepper_x ENABLE=0", "G1 Y190 F6000")
    assert levels(found, "x") == [True, False]
    assert steps(found, "y")[-1] > switched(found, "x")[-1][0]


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("SET_STEPPER_ENABLE STEPPER=q", "no 'q'; there is stepper_x, stepper_y, stepper_z"),
        ("SET_STEPPER_ENABLE STEPPER=stepper_x ENABLE=2", "give 0 or 1"),
        ("STEPPER_BUZZ STEPPER=stepper_q", "there is no 'stepper_q'; did you mean stepper_z?"),
    ],
)
def test_bad_parameters_end_the_program_with_the_line(tmp_path: Path, line: str, sentence: str) -> None:
    error = ProgramStage(tmp_path, machine=with_enable_pins()).error(line)
    assert error.startswith("part.gcode:1: ")
    assert sentence in error


def test_a_motor_goes_to_and_fro_ten_times_and_stays_homed(tmp_path: Path) -> None:
    found = printer(tmp_path)
    found.run("G28 X", "STEPPER_BUZZ STEPPER=stepper_x", "G1 X3 F6000")
    assert len(steps(found, "x")) > 20 * 80
    assert found.true_mm("x", 0) == pytest.approx(3, abs=1.1 / 80)
    assert levels(found, "x") == [True]
    assert not steps(found, "y")

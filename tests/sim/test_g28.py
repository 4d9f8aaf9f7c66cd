"""G28 of a program on simulated boards: every axis goes to its switch, and the program goes on from there."""

from pathlib import Path

import pytest

from coordinator.gcode.errors import GCodeError
from tests.stages.printer_text import SWITCHES_CFG
from tests.stages.switch_printer import STEPS_PER_MM, SwitchPrinter


def test_all_axes_are_homed_and_the_program_goes_on(tmp_path: Path) -> None:
    printer = SwitchPrinter(tmp_path, {"x": -20.0, "y": 15.0, "z": -4.0})
    printer.run("G28", "G1 X30 Y200 Z10 F6000", "M114", "G1 X31", "M119")
    assert printer.output == ["X:30.000 Y:200.000 Z:10.000 E:0.000", "x:open y:open z:open"]
    for axis, endstop_mm, wanted in (("x", 0, 31), ("y", 250, 200), ("z", -0.5, 10)):
        assert printer.true_mm(axis, endstop_mm) == pytest.approx(wanted, abs=1.1 / STEPS_PER_MM[axis]), axis


def test_an_axis_that_stands_on_its_switch_leaves_it_first(tmp_path: Path) -> None:
    printer = SwitchPrinter(tmp_path, {"x": 1.0, "y": 15.0, "z": -4.0})
    printer.distance_mm["x"] = -0.0125
    printer.run("G28 X", "G1 X5 F6000", "G28 X", "G1 X7")
    assert printer.true_mm("x", 0) == pytest.approx(7, abs=1.1 / 80)


def test_a_switch_that_never_comes_ends_the_program_with_the_line(tmp_path: Path) -> None:
    printer = SwitchPrinter(tmp_path, {"y": 15.0, "z": -4.0})
    with pytest.raises(
        GCodeError, match=r"^part\.gcode:2: axis x moved 375 mm and its endstop did not switch"
    ):
        printer.run("G28 Y", "G28 X", "G1 X5 F6000")


def test_two_homings_in_one_program(tmp_path: Path) -> None:
    printer = SwitchPrinter(tmp_path, {"x": -20.0, "y": 15.0, "z": -4.0})
    printer.run("G28", "G1 X30 Y200 Z10 F6000", "G28 X", "G1 X12.5", "G28 Z", "G1 Z3")
    for axis, endstop_mm, wanted in (("x", 0, 12.5), ("y", 250, 200), ("z", -0.5, 3)):
        assert printer.true_mm(axis, endstop_mm) == pytest.approx(wanted, abs=1.1 / STEPS_PER_MM[axis]), axis


def test_motors_are_switched_on_before_they_move_and_off_by_m84(tmp_path: Path) -> None:
    text = SWITCHES_CFG.replace("dir_pin: PB1\n", "dir_pin: PB1\nenable_pin: !PC0\n")
    printer = SwitchPrinter(tmp_path, {"x": -20.0, "y": 15.0, "z": -4.0}, machine=text)
    with pytest.raises(GCodeError, match=r"^part\.gcode:4: X is to move before it is homed"):
        printer.run("G28", "G1 X30 F6000", "M84", "G1 X31")
    pins = printer.stage.pins("mcu")
    edges = printer.stage._boards["mcu"].node.edges()
    enable = edges[edges["pin"] == pins["PC0"]]
    steps = edges[edges["pin"] == pins["PB0"]]
    assert [int(level) for level in enable["level"][-2:]] == [0, 1]
    on, off = (int(time) for time in enable["true_ps"][-2:])
    assert on < steps["true_ps"].min()
    assert off > steps["true_ps"].max()

"""G28 of a program on simulated boards: every axis goes to its switch, and the program goes on from there."""

import asyncio
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from coordinator.gcode.errors import GCodeError
from coordinator.gcode.program import Program
from coordinator.move_source import Told
from coordinator.session import Outcome, run_job
from coordinator.simulate import scenario as scenarios
from coordinator.simulate.stage import Stage

MACHINE = """
[mcu]
canbus_uuid: 90a4ae022dfc
canbus_interface: can0

[mcu toolhead]
canbus_uuid: 5e1ec7ab1e02
canbus_interface: can0

[printer]
kinematics: cartesian
max_velocity: 250
max_accel: 3000
max_z_velocity: 20
max_z_accel: 500

[stepper_x]
step_pin: PB0
dir_pin: PB1
microsteps: 16
rotation_distance: 40
endstop_pin: ^toolhead:PC5
position_endstop: 0
position_max: 250
homing_speed: 50

[stepper_y]
step_pin: PB3
dir_pin: !PB4
microsteps: 16
rotation_distance: 40
endstop_pin: PC6
position_endstop: 250
position_max: 250
homing_speed: 40
homing_retract_dist: 3

[stepper_z]
step_pin: PB6
dir_pin: PB7
microsteps: 16
rotation_distance: 8
endstop_pin: PC7
position_endstop: -0.5
position_min: -1
position_max: 250
homing_speed: 8
second_homing_speed: 2
"""
STEPS_PER_MM = {"x": 80, "y": 80, "z": 400}
PINS = {"x": ("PB0", "PB1", 1), "y": ("PB3", "PB4", -1), "z": ("PB6", "PB7", 1)}
"""Step pin, direction pin, and whether a high direction pin means forwards (1) or backwards (-1)."""


@dataclass
class Printer:
    """A machine whose axes stand some way from their switches: DISTANCE_MM, signed along the axis."""

    folder: Path
    distance_mm: dict[str, float]
    machine: str = MACHINE
    settings: str = ""
    seed: int = 0
    told: list[str] = field(default_factory=list)

    def run(self, *lines: str) -> Outcome:
        (self.folder / "home.cfg").write_text(self.machine)
        (self.folder / "home.toml").write_text(f'about = "G28."\nmachine = "home.cfg"\n{self.settings}')
        self.stage = Stage(scenarios.find(str(self.folder / "home.toml")), self.seed)
        mcu, toolhead = (self.stage._boards[name].node for name in ("mcu", "toolhead"))
        pins = self.stage.pins("mcu")
        self.axes = {}
        for axis, mm in self.distance_mm.items():
            step, direction, sign = PINS[axis]
            at = round(mm * STEPS_PER_MM[axis])
            self.axes[axis] = mcu.add_axis(
                pins[step],
                pins[direction],
                target=toolhead if axis == "x" else mcu,
                target_pin=pins[{"x": "PC5", "y": "PC6", "z": "PC7"}[axis]],
                at=sign * at,
                direction=sign * (1 if mm > 0 else -1),
            )
        with asyncio.Runner(loop_factory=self.stage.make_loop) as runner:
            return runner.run(self._main(lines))

    async def _main(self, lines: tuple[str, ...]) -> Outcome:
        return await run_job(
            self.stage.description,
            Program.from_lines(lines, "part.gcode"),
            lambda _: None,
            on_told=self._tell,
            host=self.stage.host,
        )

    def _tell(self, told: Told) -> None:
        self.told.append(told.text)

    def true_mm(self, axis: str, endstop_mm: float) -> float:
        """Return where an axis is, with its switch at ENDSTOP_MM, by the steps that were made."""
        step, direction, sign = PINS[axis]
        pins = self.stage.pins("mcu")
        edges = self.stage._boards["mcu"].node.edges()
        level, steps = 0, 0
        for pin, high in zip(edges["pin"], edges["level"], strict=True):
            if pin == pins[direction]:
                level = int(high)
            elif pin == pins[step] and high:
                steps += 1 if level else -1
        return endstop_mm + sign * steps / STEPS_PER_MM[axis] - self.distance_mm[axis]


def test_all_axes_are_homed_and_the_program_goes_on(tmp_path: Path) -> None:
    printer = Printer(tmp_path, {"x": -20.0, "y": 15.0, "z": -4.0})
    printer.run("G28", "G1 X30 Y200 Z10 F6000", "M114", "G1 X31", "M119")
    assert printer.told == ["X:30.000 Y:200.000 Z:10.000 E:0.000", "x:open y:open z:open"]
    for axis, endstop_mm, wanted in (("x", 0, 31), ("y", 250, 200), ("z", -0.5, 10)):
        assert printer.true_mm(axis, endstop_mm) == pytest.approx(wanted, abs=1.1 / STEPS_PER_MM[axis]), axis


def test_an_axis_that_stands_on_its_switch_leaves_it_first(tmp_path: Path) -> None:
    printer = Printer(tmp_path, {"x": 1.0, "y": 15.0, "z": -4.0})
    printer.distance_mm["x"] = -0.0125
    printer.run("G28 X", "G1 X5 F6000", "G28 X", "G1 X7")
    assert printer.true_mm("x", 0) == pytest.approx(7, abs=1.1 / 80)


def test_a_switch_that_never_comes_ends_the_program_with_the_line(tmp_path: Path) -> None:
    printer = Printer(tmp_path, {"y": 15.0, "z": -4.0})
    with pytest.raises(
        GCodeError, match=r"^part\.gcode:2: axis x moved 375 mm and its endstop did not switch"
    ):
        printer.run("G28 Y", "G28 X", "G1 X5 F6000")


def test_two_homings_in_one_program(tmp_path: Path) -> None:
    printer = Printer(tmp_path, {"x": -20.0, "y": 15.0, "z": -4.0})
    printer.run("G28", "G1 X30 Y200 Z10 F6000", "G28 X", "G1 X12.5", "G28 Z", "G1 Z3")
    for axis, endstop_mm, wanted in (("x", 0, 12.5), ("y", 250, 200), ("z", -0.5, 3)):
        assert printer.true_mm(axis, endstop_mm) == pytest.approx(wanted, abs=1.1 / STEPS_PER_MM[axis]), axis


def test_motors_are_switched_on_before_they_move_and_off_by_m84(tmp_path: Path) -> None:
    text = MACHINE.replace("dir_pin: PB1\n", "dir_pin: PB1\nenable_pin: !PC0\n")
    printer = Printer(tmp_path, {"x": -20.0, "y": 15.0, "z": -4.0}, machine=text)
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

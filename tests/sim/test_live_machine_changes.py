"""Commands that change what motors do in the middle of a print, on simulated boards, exact to the step."""

import pytest

from coordinator.support.examples import EXAMPLES
from tests.stages.simulated_demo import SimulatedDemo

TURN_MM = 22.67895
STEP_MM = TURN_MM / (200 * 16 * 5)
TOWER = """\
G28
G90
M83
G1 X20 Y20 Z0.5 F9000
TUNING_TOWER COMMAND="SET_EXTRUDER_ROTATION_DISTANCE EXTRUDER=extruder" PARAMETER=distance \
START=20 STEP_DELTA=-5 STEP_HEIGHT=2 SKIP=1
G1 X30 E0.7
G1 Z2 F600
G1 X20 E0.6 F3000
G1 E-0.5
G1 Z3.5
G1 E0.5
G1 Z3
G1 X30 E0.4
G3 X20 I-5 Z5 E0.8
G1 Z0.5
G1 X30 E0.9
SET_EXTRUDER_ROTATION_DISTANCE EXTRUDER=extruder DISTANCE=-45.3579
G1 X20 E1.1
"""
CARRIAGES = """\
G1 X60 F9000
SET_DUAL_CARRIAGE CARRIAGE=1
G1 X200
SET_DUAL_CARRIAGE CARRIAGE=0
SET_DUAL_CARRIAGE CARRIAGE=1 MODE=COPY
SAVE_DUAL_CARRIAGE_STATE NAME=there
SET_DUAL_CARRIAGE CARRIAGE=1
G1 X260
SET_DUAL_CARRIAGE CARRIAGE=0
G1 X190.013 Y31.7
RESTORE_DUAL_CARRIAGE_STATE NAME=there
G1 X83.107
"""


def test_a_tower_another_way_per_turn_and_carriages_that_go_back() -> None:
    demo = SimulatedDemo(EXAMPLES / "idex.cfg")
    report = demo.prove(TOWER + CARRIAGES)
    assert report.ok, report.to_text()
    # At 0.5 and 2 mm: 20 mm per turn; at 3 and 5 mm: 15 and 10; then another print begins with the last one.
    pushed = (0.7 + 0.6) / 20 + (-0.5 + 0.5) / 20 + 0.4 / 15 + 0.8 / 10 + 0.9 / 10 - 1.1 / (2 * TURN_MM)
    moved = {stepper.stepper: stepper.position_executed for stepper in report.steppers}
    assert moved["extruder"] == pytest.approx(pushed * TURN_MM / STEP_MM, abs=2)
    assert moved["extruder1"] == 0
    assert demo.true_mm("x") == pytest.approx(83.107, abs=0.0125)
    assert demo.true_mm("dual_carriage") == pytest.approx(223.107, abs=0.0125)
    assert demo.true_mm("y") == pytest.approx(31.7, abs=0.0125)


SWAPPED = """\
G28
G90
M83
G1 X50 Y60 Z10 F9000
SET_STEPPER_CARRIAGES STEPPER=screw CARRIAGES=2*z
G1 Z12
SET_STEPPER_CARRIAGES STEPPER=belt_a CARRIAGES=x-y DISABLE_CHECKS=1
SET_STEPPER_CARRIAGES STEPPER=belt_b CARRIAGES=x+y DISABLE_CHECKS=1
SET_STEPPER_CARRIAGES STEPPER=belt_a1 CARRIAGES=x-y DISABLE_CHECKS=1
SET_STEPPER_CARRIAGES STEPPER=belt_b1 CARRIAGES=y+x
G1 X70.03 Y50.01
"""


def test_motors_that_follow_other_carriages_from_a_line_on() -> None:
    demo = SimulatedDemo(EXAMPLES / "generic_cartesian.cfg")
    report = demo.prove(SWAPPED)
    assert all(stepper.holds for stepper in report.steppers), report.to_text()
    # Both belts have changed places: what was Y goes the other way; and Z goes twice as far.
    for axis, place in {"x": 70.03, "y": 60 + (60 - 50.01), "z": 10 + 2 * 2}.items():
        assert demo.true_mm(axis) == pytest.approx(place, abs=0.0125), axis


def test_homing_and_positions_are_those_of_the_motors_as_they_are() -> None:
    demo = SimulatedDemo(EXAMPLES / "generic_cartesian.cfg")
    said: list[str] = []
    demo.print_lines(
        [
            "SET_STEPPER_CARRIAGES STEPPER=screw CARRIAGES=0.5*z",
            "G28",
            "G1 X20 Y20 Z8 F3000",
            "GET_POSITION",
        ],
        on_output=lambda output: said.append(output.text),
    )
    assert demo.true_mm("z") == pytest.approx(4, abs=0.0125), "half a way per way of the axis"
    kinematic = next(line for line in said if line.startswith("kinematic:"))
    assert float(kinematic.rpartition("Z:")[2]) == pytest.approx(8, abs=0.0125)

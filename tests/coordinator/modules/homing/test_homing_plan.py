"""Which motors go towards which endstops, how far at most, and where that leaves the head."""

from dataclasses import replace
from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.model import MachineDescription
from coordinator.modules.homing.homing_plan import approaches, landed, second_landed
from coordinator.support.examples import EXAMPLES
from tests.stages.printer_text import changed, example_text, write

PLACE = (1.0, 2.0, 3.0)
"""Where the head was before."""
TOWER_Y = 7.0
"""Where the rail of Y is, on a machine whose towers do not move it."""
BEYOND = (0.5, 0.25, 0.125)


def example(name: str) -> MachineDescription:
    return load_machine(str(EXAMPLES / f"{name}.cfg"))


def figures(machine: MachineDescription) -> list[tuple[tuple[str, ...], str, str, dict[str, float]]]:
    return [
        (tuple(rail.axis for rail in approach.rails), approach.letters, approach.axis, dict(approach.ways))
        for approach in approaches(machine)
    ]


def lengths(machine: MachineDescription) -> list[float]:
    return [approach.most_mm for approach in approaches(machine)]


def ends(machine: MachineDescription) -> list[tuple[float, float, float]]:
    return [
        landed(machine, approach, BEYOND[: len(approach.rails)], PLACE, TOWER_Y)
        for approach in approaches(machine)
    ]


def test_axes_one_after_the_other_with_all_motors_that_move_them() -> None:
    machine = example("corexy")
    assert figures(machine) == [
        (("x",), "X", "x", {"stepper_x": -1, "stepper_y": -1}),
        (("y",), "Y", "y", {"stepper_x": -1, "stepper_y": 1}),
        (("z",), "Z", "z", {"stepper_z": -1}),
    ]
    assert lengths(machine) == [352.5, 352.5, 375.0]
    assert ends(machine) == [(-0.5, 2.0, 3.0), (1.0, -0.5, 3.0), (1.0, 2.0, -0.5)]
    assert all(approach.possible and not approach.is_second_carriage for approach in approaches(machine))


def test_the_arm_of_a_polar_machine_alone() -> None:
    machine = example("polar")
    assert figures(machine) == [
        (("arm",), "XY", "x", {"stepper_arm": 1.0}),
        (("z",), "Z", "z", {"stepper_z": -1}),
    ]
    assert lengths(machine) == [217.5, 375.0]
    assert ends(machine) == [(150.5, 0.0, 3.0), (1.0, 2.0, -0.5)]


def test_towers_all_together() -> None:
    machine = example("delta")
    assert figures(machine) == [
        (("a", "b", "c"), "XYZ", "z", {"stepper_a": 1.0, "stepper_b": 1.0, "stepper_c": 1.0})
    ]
    low, high = machine.kinematics.work_space.low[2], machine.kinematics.work_space.high[2]
    assert low == -2
    assert lengths(machine) == [1.5 * (high + 2)]
    (end,) = ends(machine)
    rails = machine.kinematics.inverse(machine.home)
    beyond = [rail + mm for rail, mm in zip(rails, BEYOND, strict=True)]
    assert machine.kinematics.inverse(end) == pytest.approx(beyond)


def test_two_towers_and_a_y_of_its_own() -> None:
    machine = example("deltesian")
    assert figures(machine) == [
        (("left", "right"), "XYZ", "z", {"stepper_left": 1.0, "stepper_right": 1.0}),
        (("y",), "Y", "y", {"stepper_y": -1}),
    ]
    towers, y = ends(machine)
    assert towers[1] == TOWER_Y
    assert towers == pytest.approx((-0.2369, 7.0, 300.3751), abs=1e-4)
    assert y == (1.0, -0.5, 3.0)


def test_arms_turn_as_far_as_their_elbows_go() -> None:
    machine = example("rotary_delta")
    elbow_mm = machine.motors[0].function.params[0]
    assert elbow_mm == 170
    assert figures(machine) == [
        (("a", "b", "c"), "XYZ", "z", dict.fromkeys(("stepper_a", "stepper_b", "stepper_c"), 1 / 170))
    ]
    assert lengths(machine) == [pytest.approx(1.5 * 3.14159265 * 170)]
    (end,) = ends(machine)
    angles = machine.kinematics.inverse(machine.home)
    turned = [angle + mm / 170 for angle, mm in zip(angles, BEYOND, strict=True)]
    assert machine.kinematics.inverse(end) == pytest.approx(turned)


def test_a_second_carriage_alone_behind_the_first_one() -> None:
    machine = example("idex")
    assert figures(machine)[:3] == [
        (("x",), "X", "x", {"stepper_x": -1}),
        (("dual_carriage",), "X", "x", {"dual_carriage": 1.0}),
        (("y",), "Y", "y", {"stepper_y": -1}),
    ]
    assert [approach.is_second_carriage for approach in approaches(machine)] == [False, True, False, False]
    second = approaches(machine)[1]
    assert second.most_mm == 525.0
    assert second_landed(second, [0.5]) == 350.5
    assert ends(machine)[0] == (-50.5, 2.0, 3.0)


def generic(old: str, new: str) -> str:
    return changed(old, new, example_text("generic_cartesian"))


def test_a_belt_that_takes_half_of_an_axis_goes_half_as_far(tmp_path: Path) -> None:
    machine = load_machine(write(tmp_path, generic("carriages: x+y", "carriages: - .5 * y + x")))
    x, y, _ = figures(machine)
    assert (x[3]["belt_a"], y[3]["belt_a"]) == (-1, 0.5)


@pytest.mark.parametrize("end", ["", "endstop_pin: PF2\n"])
def test_a_second_carriage_is_homed_where_it_has_an_endstop(tmp_path: Path, end: str) -> None:
    text = generic("carriages: x-y\n", "carriages: .5*u+y\n") + (
        f"\n[dual_carriage u]\nprimary_carriage: x\nposition_min: 40\nposition_max: 300\n{end}"
        "position_endstop: 40\n"
        "[stepper head]\nstep_pin: PE0\ndir_pin: PE1\nmicrosteps: 16\nrotation_distance: 40\ncarriages: x\n"
    )
    seconds = [a for a in approaches(load_machine(write(tmp_path, text))) if a.is_second_carriage]
    if not end:
        assert seconds == []
        return
    (second,) = seconds
    assert (second.letters, second.axis, second.most_mm) == ("X", "x", 390.0)
    assert set(second.ways.values()) == {-0.5}
    assert second_landed(second, [0.25]) == 39.75


def test_a_belt_without_end_has_its_endstop_within_150_m(tmp_path: Path) -> None:
    text = changed("position_max: 250\n", "position_max: 100001\n", example_text("corexy"))
    machine = load_machine(write(tmp_path, text))
    assert 150_000.0 in lengths(machine)


def test_it_is_possible_where_each_rail_has_an_endstop() -> None:
    (towers,) = approaches(example("delta"))
    first = replace(towers.rails[0], homing=replace(towers.rails[0].homing, endstop_pin=None))
    assert towers.possible
    assert not replace(towers, rails=(first, *towers.rails[1:])).possible


def test_a_machine_without_rails_has_none() -> None:
    assert approaches(example("winch")) == []

"""The example machine of each kinematics: what it is read as."""

import math
from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.model import MachineDescription
from coordinator.config.sections.printer import KINEMATICS
from coordinator.kinematics.delta import Delta
from coordinator.kinematics.deltesian import Deltesian
from coordinator.kinematics.dual_carriage import CarriageMode
from coordinator.kinematics.polar import Polar
from coordinator.kinematics.rotary_delta import RotaryDelta
from coordinator.kinematics.winch import Winch
from coordinator.support.examples import EXAMPLES
from tests.stages.printer_text import PRINTER_CFG, changed, example_text, write


def example(name: str) -> MachineDescription:
    return load_machine(str(EXAMPLES / f"{name}.cfg"))


@pytest.mark.parametrize("name", KINEMATICS.choices)
def test_every_kinematics_has_its_example(name: str) -> None:
    machine = example(name)
    kinematics = machine.kinematics
    assert kinematics.name == name
    assert machine.limits.position_min == kinematics.work_space.low
    assert machine.limits.position_max == kinematics.work_space.high
    functions = [stepper.function for stepper in machine.motors if stepper.name[-1] != "1"]
    assert [f for f in functions if f in kinematics.step_functions()] == functions
    # The head is where homing leaves it: the rails are where their endstops are.
    assert kinematics.forward(kinematics.inverse(machine.home)) == pytest.approx(machine.home, abs=1e-6)
    assert list(machine.homed_position) == ["X", "Y", "Z"]


def test_a_delta() -> None:
    machine = example("delta")
    assert isinstance(machine.kinematics, Delta)
    a, b, c = machine.kinematics.towers
    assert [round(math.degrees(t.angle)) for t in (a, b, c)] == [210, 330, 90]
    assert {(t.rod_length, t.endstop_height) for t in (a, b, c)} == {(330, 400)}
    assert [rail.axis for rail in machine.rails] == ["a", "b", "c"]
    assert all(rail.homing.positive_dir and rail.position_max is None for rail in machine.rails)
    assert machine.home == (0, 0, 400)
    limits = machine.limits
    assert (limits.max_radius, limits.position_min[2], limits.cone_top) == (140, -2, 400)
    assert limits.cone_slope[0] == pytest.approx(150 / math.sqrt(330**2 - 150**2))


def test_the_print_radius_ends_where_rods_lie_flat(tmp_path: Path) -> None:
    text = changed("print_radius: 140\n", "", example_text("delta"))
    assert load_machine(write(tmp_path, text)).limits.max_radius == 150  # delta_radius
    limits = load_machine(write(tmp_path, changed("arm_length: 330", "arm_length: 200", text))).limits
    assert limits.max_radius == pytest.approx(200 * math.sin(math.atan(12)) - 150)


def test_a_print_radius_beyond_what_the_rods_allow_ends_there_with_a_notice(tmp_path: Path) -> None:
    machine = load_machine(
        write(tmp_path, changed("print_radius: 140", "print_radius: 190", example_text("delta")))
    )
    assert machine.limits.max_radius == pytest.approx(330 * math.sin(math.atan(12)) - 150)
    (note,) = machine.notes
    assert "'print_radius' of [printer] is 190 mm, but the rods lie too flat beyond 178.86 mm" in note


def test_endstops_of_different_height_tilt_where_homing_ends(tmp_path: Path) -> None:
    text = example_text("delta").replace("angle: 330\n", "angle: 330\nposition_endstop: 401\n")
    machine = load_machine(write(tmp_path, text))
    kinematics = machine.kinematics
    assert isinstance(kinematics, Delta)
    assert kinematics.inverse(machine.home) == pytest.approx(kinematics.endstop_positions)
    assert machine.limits.cone_top == 400
    assert machine.home != (0, 0, 400)


def test_a_deltesian() -> None:
    machine = example("deltesian")
    assert isinstance(machine.kinematics, Deltesian)
    assert (machine.kinematics.left.x, machine.kinematics.right.x) == (-140, 140)
    assert machine.kinematics.right.rod_length == 300
    assert [rail.axis for rail in machine.rails] == ["left", "right", "y"]
    assert machine.home == (0, 0, 300)


def test_a_polar_machine() -> None:
    machine = example("polar")
    assert isinstance(machine.kinematics, Polar)
    assert machine.steppers[0].step_distance == pytest.approx(math.tau / (200 * 16 * 5))
    assert machine.home == (150, 0, 0)
    assert (machine.limits.max_radius, machine.limits.radius_min) == (150, 5)


def test_a_rotary_delta() -> None:
    machine = example("rotary_delta")
    assert isinstance(machine.kinematics, RotaryDelta)
    assert machine.kinematics.inverse(machine.home) == pytest.approx(machine.kinematics.endstop_positions)
    gears = 107 / 16 * 60 / 16
    assert machine.steppers[0].step_distance == pytest.approx(math.tau / (200 * 16 * gears))
    assert machine.kinematics.work_space.max_radius > 150


def test_a_winch_machine() -> None:
    machine = example("winch")
    assert isinstance(machine.kinematics, Winch)
    assert [stepper.function.params for stepper in machine.motors] == list(machine.kinematics.anchors)
    assert len(machine.motors) == 4


def test_a_generic_machine(tmp_path: Path) -> None:
    machine = example("generic_cartesian")
    assert [(s.name, s.weights) for s in machine.motors] == [
        ("belt_a", (1, 1, 0, 0)),
        ("belt_a1", (1, 1, 0, 0)),
        ("belt_b", (1, -1, 0, 0)),
        ("belt_b1", (1, -1, 0, 0)),
        ("screw", (0, 0, 1, 0)),
    ]
    assert [len(rail.steppers) for rail in machine.rails] == [4, 4, 1]
    text = example_text("generic_cartesian").replace("carriages: x+y", "carriages: - .5 * y + x", 1)
    machine = load_machine(write(tmp_path, text))
    assert machine.motors[0].weights == (1, -0.5, 0, 0)


def test_a_generic_machine_with_two_carriages(tmp_path: Path) -> None:
    text = example_text("generic_cartesian").replace("carriages: x-y\n", "carriages: u+y\n")
    text += (
        "\n[dual_carriage u]\nprimary_carriage: x\nposition_min: 40\nposition_max: 300\n"
        "position_endstop: 300\n"
        "[stepper head]\nstep_pin: PE0\ndir_pin: PE1\nmicrosteps: 16\nrotation_distance: 40\ncarriages: x\n"
        "[extra_carriage y2]\nprimary_carriage: y\nendstop_pin: PF1\n"
    )
    machine = load_machine(write(tmp_path, text))
    dual = machine.dual_carriage
    assert dual is not None
    assert [stepper.name for stepper in dual.rails[1].steppers] == ["belt_b", "belt_b1"]
    assert dual.carriages.safe_distance == 40
    weights = {stepper.name: stepper.weights for stepper in machine.motors}
    assert weights["belt_b"] == (0, 1, 0, 0)  # parked, but y moves its belt
    state = dual.carriages.set_mode(dual.carriages.home, 0, 1, CarriageMode.PRIMARY)
    assert dual.carriages.weights(state)["belt_b"] == (1, 1, 0, 0)
    assert dual.carriages.weights(state)["belt_a"] == (0, 1, 0, 0)


def test_an_idex_machine() -> None:
    machine = example("idex")
    dual = machine.dual_carriage
    assert dual is not None
    assert (dual.carriages.axis, dual.carriages.safe_distance) == (0, 50)
    assert [(c.low, c.high, c.home) for c in dual.carriages.carriages] == [(-50, 300, -50), (0, 350, 350)]
    weights = {stepper.name: stepper.weights for stepper in machine.steppers}
    assert weights["dual_carriage"] == (0, 0, 0, 0)
    assert [extruder.name for extruder in machine.extruders] == ["extruder", "extruder1"]
    assert machine.limits is machine.extruders[0].limits


def test_the_second_belt_of_a_hybrid_runs_the_other_way_round(tmp_path: Path) -> None:
    idex = example_text("idex")
    text = example_text("hybrid_corexy")
    text += idex[idex.index("[dual_carriage]") : idex.index("[extruder]")]
    text = text.replace("PA9\n", "PF9\n", 1).replace("PA10\n", "PF10\n", 1).replace("PA11\n", "PF11\n", 1)
    machine = load_machine(write(tmp_path, text))
    dual = machine.dual_carriage
    assert dual is not None
    state = dual.carriages.set_mode(dual.carriages.home, 0, 1, CarriageMode.PRIMARY)
    assert dual.carriages.weights(state) == {"stepper_x": (0, -1, 0, 0), "dual_carriage": (1, 1, 0, 0)}


def test_extruders_and_what_follows_them() -> None:
    machine = example("extruders")
    assert [(e.name, e.pressure_advance, e.smooth_time_s) for e in machine.extruders] == [
        ("extruder", 0.04, 0.04),
        ("extruder1", 0.06, 0.04),
    ]
    feeder = machine.extruder_steppers[0]
    assert (feeder.name, feeder.extruder, feeder.stepper.name) == ("feeder", "extruder", "feeder")
    weights = {stepper.name: stepper.weights[3] for stepper in machine.steppers}
    assert (weights["extruder"], weights["extruder1"], weights["feeder"]) == (1, 0, 1)


@pytest.mark.parametrize("name", ["idex", "extruders", "delta"])
def test_steppers_begin_with_the_weights_of_the_initial_state(name: str) -> None:
    machine = example(name)
    weights = machine.extruder_motion.weights()
    if machine.dual_carriage is not None:
        weights |= machine.dual_carriage.carriages.weights(machine.dual_carriage.carriages.home)
    assert weights == {s.name: s.weights for s in machine.steppers if s.name in weights}
    assert {extruder.stepper.name for extruder in machine.extruders} <= set(weights)


def test_shapers(tmp_path: Path) -> None:
    assert example("winch").shapers == ()
    text = PRINTER_CFG + "[input_shaper]\nshaper_type: ei\nshaper_type_y: 3hump_ei\nshaper_freq_y: 40\n"
    text += "shaper_freq_x: 55.5\ndamping_ratio_x: 0.05\n"
    shapers = load_machine(write(tmp_path, text)).shapers
    assert [(s.axis, s.kind, s.frequency_hz, s.damping_ratio) for s in shapers] == [
        ("x", "ei", 55.5, 0.05),
        ("y", "3hump_ei", 40, 0.1),
    ]


def test_limits_of_single_axes(tmp_path: Path) -> None:
    text = changed("max_accel: 5000\n", "max_accel: 5000\nmax_x_accel: 4000\nmax_y_velocity: 200\n")
    limits = load_machine(write(tmp_path, text)).limits
    assert (limits.max_x_accel, limits.max_y_velocity) == (4000, 200)
    assert (limits.max_x_velocity, limits.max_y_accel) == (0, 0)

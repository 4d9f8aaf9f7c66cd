import math
from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.assembly.reference import SECTIONS
from coordinator.config.model import CanConnection, MachineDescription, UartConnection
from coordinator.config.options import Option, SectionSpec
from coordinator.config.unsupported import UNSUPPORTED_SECTIONS
from coordinator.support.examples import EXAMPLES
from tests.stages.printer_text import PRINTER_CFG, changed, write

SHARED = Path(__file__).parents[3] / ".." / "shared" / "data" / "config"


def load(tmp_path: Path, text: str) -> MachineDescription:
    return load_machine(write(tmp_path, text))


def test_the_small_machine(tmp_path: Path) -> None:
    machine = load(tmp_path, PRINTER_CFG)
    assert [node.name for node in machine.nodes] == ["mcu", "toolhead"]
    can, uart = (node.connection for node in machine.nodes)
    assert isinstance(can, CanConnection)
    assert (can.uuid, can.interface) == ("11aa22bb33cc", "can0")
    assert isinstance(uart, UartConnection)
    assert (uart.path, uart.baud, uart.restart_method) == ("/dev/ttyACM0", 250_000, "arduino")
    assert machine.kinematics.name == "corexy"
    assert [(s.name, s.node, s.weights) for s in machine.steppers] == [
        ("stepper_x", "mcu", (1, 1, 0, 0)),
        ("stepper_y", "mcu", (1, -1, 0, 0)),
        ("stepper_z", "mcu", (0, 0, 1, 0)),
        ("extruder", "toolhead", (0, 0, 0, 1)),
    ]
    assert [s.step_distance for s in machine.steppers] == [0.0125, 0.0125, 0.0025, 22.5 / 3200]
    assert all(s.step_pulse_s == 2e-6 and s.enable_pin is None for s in machine.steppers)
    assert machine.unsupported == ()
    assert machine.notes == ()


def test_default_limits_follow_the_documented_formulas(tmp_path: Path) -> None:
    limits = load(tmp_path, PRINTER_CFG).limits
    ratio = 4 * 0.4**2 / (math.pi * (1.75 / 2) ** 2)
    assert (limits.max_velocity, limits.max_z_velocity) == (300, 300)
    assert (limits.max_accel, limits.max_z_accel) == (5000, 5000)
    assert (limits.square_corner_velocity, limits.minimum_cruise_ratio) == (5, 0.5)
    assert limits.position_min == (0, 0, 0)
    assert limits.position_max == (200, 210, 220)
    assert limits.max_extrude_ratio == pytest.approx(ratio)
    assert limits.max_extrude_only_velocity == pytest.approx(300 * ratio)
    assert limits.max_extrude_only_accel == pytest.approx(5000 * ratio)
    assert (limits.max_extrude_only_distance, limits.instantaneous_corner_velocity) == (50, 1)


def test_given_limits_win(tmp_path: Path) -> None:
    text = changed(
        "max_accel: 5000\n", "max_accel: 5000\nmax_z_velocity: 7\nmax_z_accel: 70\nmax_accel_to_decel: 2000\n"
    )
    text += (
        "max_extrude_cross_section: 5\nmax_extrude_only_velocity: 60\nmax_extrude_only_accel: 600\n"
        "max_extrude_only_distance: 100\ninstantaneous_corner_velocity: 0\n"
    )
    limits = load(tmp_path, text).limits
    assert (limits.max_z_velocity, limits.max_z_accel) == (7, 70)
    assert limits.minimum_cruise_ratio == pytest.approx(0.6)
    assert limits.max_extrude_ratio == pytest.approx(5 / (math.pi * 0.875**2))
    assert (limits.max_extrude_only_velocity, limits.max_extrude_only_accel) == (60, 600)
    assert (limits.max_extrude_only_distance, limits.instantaneous_corner_velocity) == (100, 0)


def test_without_extruder_no_filament_may_move(tmp_path: Path) -> None:
    machine = load(tmp_path, PRINTER_CFG[: PRINTER_CFG.index("[extruder]")])
    assert machine.extruder is None
    assert len(machine.steppers) == 3
    assert (machine.limits.max_extrude_ratio, machine.limits.max_extrude_only_distance) == (0, 0)


def test_cartesian_weights_and_gears(tmp_path: Path) -> None:
    text = changed("corexy", "cartesian")
    text = changed("rotation_distance: 22.5", "rotation_distance: 22.5\ngear_ratio: 50:10, 3:2", text)
    text = changed("microsteps: 16", "microsteps: 32\nfull_steps_per_rotation: 400", text)
    machine = load(tmp_path, text)
    assert [s.weights for s in machine.steppers[:2]] == [(1, 0, 0, 0), (0, 1, 0, 0)]
    assert machine.steppers[0].step_distance == 40 / (400 * 32)
    assert machine.extruder is not None
    assert machine.extruder.stepper.gear_ratio == 7.5
    assert machine.extruder.stepper.step_distance == pytest.approx(22.5 / (3200 * 7.5))


def test_pins_keep_their_marks(tmp_path: Path) -> None:
    machine = load(
        tmp_path,
        changed("step_pin: PA0", "step_pin: !PA0").replace(
            "dir_pin: PA1", "dir_pin: ! mcu : PA1\nendstop_pin: toolhead:!^PB7\nposition_endstop: 200"
        ),
    )
    x = machine.steppers[0]
    assert (x.step_pin.node, x.step_pin.name, x.step_pin.invert) == ("mcu", "PA0", True)
    assert (x.dir_pin.node, x.dir_pin.name, x.dir_pin.invert) == ("mcu", "PA1", True)
    endstop = machine.rails[0].homing.endstop_pin
    assert endstop is not None
    assert (endstop.node, endstop.name, endstop.invert, endstop.pull) == ("toolhead", "PB7", True, 1)
    assert machine.rails[0].homing.positive_dir


def test_homing_defaults_and_virtual_endstops(tmp_path: Path) -> None:
    text = changed(
        "position_max: 220", "position_max: 220\nendstop_pin: probe:z_virtual_endstop\nhoming_speed: 12"
    )
    machine = load(tmp_path, text)
    homing = machine.rails[2].homing
    assert homing.virtual_endstop == "probe:z_virtual_endstop"
    assert (homing.endstop_pin, homing.position_endstop, homing.positive_dir) == (None, None, False)
    assert (homing.speed, homing.second_speed, homing.retract_speed, homing.retract_distance) == (
        12,
        6,
        12,
        5,
    )
    assert [(n.section, n.options) for n in machine.unsupported] == [
        ("stepper_z", ("endstop_pin", "homing_speed")),
    ]


def test_several_steppers_move_one_axis(tmp_path: Path) -> None:
    text = PRINTER_CFG + "".join(
        f"[stepper_z{n}]\nstep_pin: PC{n}\ndir_pin: PD{n}\nmicrosteps: 16\nrotation_distance: 8\n"
        f"enable_pin: !PE0\nendstop_pin: ^PF{n}\n"
        for n in (2, 1)
    )
    machine = load(tmp_path, text)
    assert [s.name for s in machine.rails[2].steppers] == ["stepper_z", "stepper_z1", "stepper_z2"]
    assert {s.weights for s in machine.rails[2].steppers} == {(0, 0, 1, 0)}
    assert [(n.section, n.options) for n in machine.unsupported] == [
        ("stepper_z1", ("endstop_pin",)),
        ("stepper_z2", ("endstop_pin",)),
    ]


def test_aliases_and_pins_shared_on_purpose(tmp_path: Path) -> None:
    text = changed("dir_pin: PA3", "dir_pin: DIR").replace("dir_pin: PA5", "dir_pin: PA1")
    text += (
        "[board_pins one]\naliases:\n  DIR=PA1,\n  GND=<GND>\naliases_more: X=PX1\n"
        "[duplicate_pin_override]\npins: DIR\n[fan]\npin: PA1\n"
    )
    machine = load(tmp_path, text)
    assert [s.dir_pin.name for s in machine.steppers[:3]] == ["PA1", "PA1", "PA1"]


def test_what_waits_for_its_module_is_listed(tmp_path: Path) -> None:
    text = PRINTER_CFG + "shared_heater: x\n[led a]\nanything: 1\n[tmc5160 stepper_x]\nuart_pin: PA0:x\n"
    machine = load(tmp_path, text)
    assert [str(entry).replace(f"{tmp_path}/", "") for entry in machine.unsupported] == [
        "printer.cfg:33: shared_heater of [extruder]: not supported yet, ignored",
        "printer.cfg:41: [led a]: not supported yet, ignored",
        "printer.cfg:43: [tmc5160 stepper_x]: not supported yet, ignored",
    ]


def test_connections(tmp_path: Path) -> None:
    text = changed("11aa22bb33cc", "11AA22bb33cc\ncanbus_interface: virtual:/run/bus one".replace(" one", ""))
    text = changed("ttyACM0", "ttyACM0\nbaud: 115200\nrestart_method: command", text)
    can, uart = (node.connection for node in load(tmp_path, text).nodes)
    assert isinstance(can, CanConnection)
    assert (can.uuid, can.interface, can.place.line) == ("11aa22bb33cc", "virtual:/run/bus", 2)
    assert isinstance(uart, UartConnection)
    assert (uart.baud, uart.restart_method) == (115_200, "command")


def test_the_primary_node_comes_first(tmp_path: Path) -> None:
    text = "[mcu late]\nserial: /dev/z\n" + PRINTER_CFG
    assert [node.name for node in load(tmp_path, text).nodes] == ["mcu", "late", "toolhead"]


@pytest.mark.parametrize("name", ["cartesian_plain", "corexy_is_pa", "corexy_is_pa_toolhead"])
def test_users_machines_load_unchanged(name: str) -> None:
    path = SHARED / f"{name}.cfg"
    if not path.is_file():
        pytest.skip("the shared example data is not here")
    machine = load_machine(str(path))
    assert len(machine.steppers) == 4
    waiting = {entry.section for entry in machine.unsupported}
    assert not waiting & {"input_shaper", "stepper_x", "stepper_z", "heater_bed", "fan"}
    assert [shaper.kind for shaper in machine.shapers] == (
        ["mzv", "mzv"] if name.startswith("corexy") else []
    )
    assert machine.steppers[3].node == ("toolhead" if name.endswith("toolhead") else "mcu")


EXAMPLE_FILES = sorted(EXAMPLES.rglob("*.cfg"))


def test_there_are_examples() -> None:
    assert EXAMPLE_FILES


@pytest.mark.parametrize("path", EXAMPLE_FILES, ids=lambda path: path.stem)
def test_examples_load(path: Path) -> None:
    machine = load_machine(str(path))
    assert machine.extruder is not None or machine.kinematics.name == "none"
    assert machine.notes == ()


@pytest.mark.parametrize("spec", SECTIONS.values(), ids=SECTIONS)
def test_specifications_are_fit_for_the_reference_page(spec: SectionSpec) -> None:
    names = [option.name for option in spec.options] + list(spec.unsupported)
    assert len(names) == len(set(names))
    assert all(name == name.lower() for name in names)
    options: tuple[Option[object], ...] = spec.options
    for option in options:
        assert option.help
        assert option.rule()
        assert not option.help.endswith(".")


def test_acting_sections_are_not_in_the_waiting_table() -> None:
    acting = {word.strip("[] ,") for title in SECTIONS for word in title.split() if "[" in word}
    assert not acting & UNSUPPORTED_SECTIONS


@pytest.mark.parametrize("method", ["arduino", "cheetah", "rpi_usb", "command"])
def test_every_restart_method_acts(tmp_path: Path, method: str) -> None:
    machine = load_machine(write(tmp_path, changed("ttyACM0", f"ttyACM0\nrestart_method: {method}")))
    uart = machine.nodes[1].connection
    assert isinstance(uart, UartConnection)
    assert uart.restart_method == method
    assert not machine.unsupported

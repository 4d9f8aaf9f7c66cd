"""Configurations as people write them: what other hosts take loads here, and what does not act is listed."""

from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.errors import ConfigError
from coordinator.config.model import MachineDescription
from coordinator.modules.drivers.tmc_driver import Tmc2209
from coordinator.modules.module_set import build_modules
from coordinator.modules.programs.idle_timeout import IdleTimeout
from tests.stages.printer_text import PRINTER_CFG, changed, write

DRIVER = "[tmc2209 stepper_x]\nuart_pin: PF0\nrun_current: 0.8\n"
HEATER = "heater_pin: PB6\nsensor_type: {sensor}\nsensor_pin: {pin}\ncontrol: watermark\n"
HEATER += "min_temp: 0\nmax_temp: 250\n"


def load(folder: Path, text: str) -> MachineDescription:
    return load_machine(write(folder, text))


def waiting(machine: MachineDescription) -> dict[str, tuple[tuple[str, ...], str]]:
    return {entry.section: (entry.options, entry.reason) for entry in machine.unsupported}


@pytest.mark.parametrize(
    "more",
    [
        f"{DRIVER}stealthchop_threshold: 999999\n",
        DRIVER.replace("2209", "2208") + "uart_address: 0\n",
        (
            "[extruder_stepper e1]\nextruder:\nstep_pin: PF1\ndir_pin: PF2\nmicrosteps: 16\n"
            "rotation_distance: 8\n"
        ),
        "[board_pins a]\naliases:\n[board_pins b]\naliases: X_EN=PF3, Y_EN=\n",
        "[gcode_macro A]\ndescription:\ngcode:\n  G4\n",
        "[gcode_macro A]\ndescription: first\n  second\ngcode:\n  G4\n",
        (
            "[bed_mesh]\nmesh_min: 5, 5\nmesh_max: 90, 90\n"
            "[gcode_macro BED_MESH_CALIBRATE]\nrename_existing: _MESH\ngcode:\n  _MESH\n"
        ),
        "[gcode_macro G0]\nrename_existing: G00\ngcode:\n  G00 {rawparams}\n",
        "[gcode_macro M204]\nrename_existing: M204.0\ngcode:\n  M204.0 {rawparams}\n",
        "[dac084S085 stepper_digipot]\nenable_pin: PF4\n",
        "[input_shaper]\nshaper_freq_x: 40\nshaper_type: ei(v_tol=.3)\nshaper_type_y: 3HUMP_EI( v_tol=.1 )\n",
        "[gcode_macro A]\ngcode:\n  {[1, 2]|random} {printer|string|pprint}\n",
        (
            "#*# <---------------------- SAVE_CONFIG ---------------------->\n#*# [bed_mesh default]\n"
            "#*# version = 1\n#*# points =\n#*# \t  0.1, 0.2, 0.3\n#*# \t  0.3, 0.4, 0.3\n#*# \t  0, 0, 0\n"
            "#*# x_count = 3\n#*# y_count = 3\n#*# mesh_x_pps = 2\n#*# mesh_y_pps = 2\n#*# algo = lagrange\n"
            "#*# tension = .2\n#*# min_x = 5\n#*# max_x = 90.5\n#*# min_y = 5\n#*# max_y = 90\n"
        ),
    ],
)
def test_it_loads(tmp_path: Path, more: str) -> None:
    load(tmp_path, PRINTER_CFG + more)


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        ("[input_shaper]\nshaper_type: ei(v_tol=0)\n", "those with ei also as in ei(v_tol=0.05)"),
        ("[input_shaper]\nshaper_type: mzv(v_tol=0.1)\n", "those with ei also as in ei(v_tol=0.05)"),
        (DRIVER.replace("2209", "2208") + "uart_address: 3\n", "at least 0 and at most 0"),
        ("[gcode_macro NONE_SUCH]\nrename_existing: X\ngcode:\n", "there is no command NONE_SUCH"),
        (
            "[gcode_macro BED_MESH_CALIBRATE]\nrename_existing: X\ngcode:\n",
            "there is no command BED_MESH_CALIBRATE",
        ),
        ("[board_pins]\naliases: A=\n[output_pin a]\npin: A\n", "alias 'A' of [board_pins] has no pin"),
        ("[output_pin a]\npin: multi_pin:b\n", "there is no node 'multi_pin'"),
        ("[multi_pin c]\npins: PF1\n[output_pin a]\npin: multi_pin:b\n", "there is no [multi_pin b]; add"),
        ("[output_pin a]\npin: sx1509_x:PIN_1\n", "there is no node 'sx1509_x'"),
    ],
)
def test_bad_input_still_gets_a_sentence(tmp_path: Path, more: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as error:
        load(tmp_path, PRINTER_CFG + more)
    assert sentence in str(error.value)


@pytest.mark.parametrize(
    ("more", "section", "reason"),
    [
        (
            "[sx1509 duex]\ni2c_address: 62\n[output_pin a]\npin: sx1509_duex:PIN_1\n",
            "output_pin a",
            "'pin' of [output_pin a] is a pin of [sx1509 duex], which is not supported yet",
        ),
        (
            "[multi_pin two]\npins: PF1, PF2\n[heater_fan a]\npin: multi_pin:two\n",
            "heater_fan a",
            "'pin' of [heater_fan a] is a pin of [multi_pin two], which is not supported yet",
        ),
        (
            "[adc_scaled vref]\nvref_pin: PF1\nvssa_pin: PF2\n[heater_bed]\n"
            + HEATER.format(sensor="Generic 3950", pin="vref:PF3"),
            "heater_bed",
            "'sensor_pin' of [heater_bed] is a pin of [adc_scaled vref], which is not supported yet",
        ),
        (
            "[heater_bed]\n" + HEATER.format(sensor="MAX31865", pin="PF3") + "spi_bus: spi1\n",
            "heater_bed",
            "its sensor is a MAX31865, which is not supported yet",
        ),
        (
            "[heater_bed]\n"
            + HEATER.format(sensor="MAX31865", pin="PF3")
            + "[verify_heater heater_bed]\nhysteresis: 4\n",
            "verify_heater heater_bed",
            "the heater heater_bed is not supported yet",
        ),
        (
            DRIVER + "select_pins: PF1\n",
            "tmc2209 stepper_x",
            "drivers that are chosen by select_pins are not supported yet",
        ),
        (
            "[manual_stepper gear]\n" + DRIVER.replace("stepper_x", "manual_stepper gear"),
            "tmc2209 manual_stepper gear",
            "it is for [manual_stepper gear], which is not supported yet",
        ),
        (
            "[gcode_shell_command a]\ncommand: ls\n[gcode_shell_command b]\ncommand: ls\n",
            "gcode_shell_command",
            "no section of that kind is run",
        ),
    ],
)
def test_what_depends_on_something_that_does_not_act_is_listed(
    tmp_path: Path, more: str, section: str, reason: str
) -> None:
    machine = load(tmp_path, PRINTER_CFG + more)
    entries = [entry for entry in machine.unsupported if entry.section == section]
    assert [(entry.options, entry.reason) for entry in entries] == [((), reason)]


def test_a_fan_of_a_heater_that_does_not_act_still_runs_for_the_others(tmp_path: Path) -> None:
    machine = load(
        tmp_path,
        PRINTER_CFG
        + "[heater_bed]\n"
        + HEATER.format(sensor="MAX31865", pin="PF3")
        + "[controller_fan a]\npin: PF5\nheater: heater_bed\n",
    )
    assert set(waiting(machine)) == {"heater_bed"}


def test_a_diag_pin_that_no_virtual_endstop_names_is_free(tmp_path: Path) -> None:
    text = changed("position_max: 200\n", "position_max: 200\nendstop_pin: ^!PC3\nposition_endstop: 0\n")
    machine = load(tmp_path, f"{text}{DRIVER}diag_pin: PC3\n")
    pin = machine.rails[0].homing.endstop_pin
    assert pin is not None
    assert (pin.name, pin.invert, pin.pull) == ("PC3", True, 1)


def test_a_motor_that_cannot_be_switched_on_is_not_homed(tmp_path: Path) -> None:
    text = changed("step_pin: PA0\n", "step_pin: PA0\nenable_pin: replicape:stepper_x_enable\n")
    machine = load(tmp_path, f"{text}[replicape]\nrevision: B3\nhost_mcu: mcu\n")
    assert waiting(machine)["stepper_x"] == (
        ("enable_pin",),
        "'enable_pin' of [stepper_x] is a pin of [replicape], which is not supported yet",
    )


def test_pwm_that_software_cannot_make_is_slowed_with_a_notice(tmp_path: Path) -> None:
    machine = load(tmp_path, PRINTER_CFG + "[fan_generic a]\npin: PF1\ncycle_time: 0.00005\n")
    (note,) = machine.notes
    assert (
        "'cycle_time' of [fan_generic a] is 5e-05 s, too short for PWM in software: 0.001 s is used" in note
    )


def test_a_current_that_the_resistor_does_not_allow_is_cut_with_a_notice(tmp_path: Path) -> None:
    machine = load(tmp_path, PRINTER_CFG + DRIVER.replace("0.8", "1.9"))
    (note,) = machine.notes
    assert (
        "is 1.9 A, but with sense_resistor 0.11 ohm the driver gives at most 1.768 A, which is used" in note
    )
    driver = build_modules(machine).find("tmc2209 stepper_x", Tmc2209)
    assert driver is not None
    assert driver.run_a == pytest.approx(1.768, abs=1e-3)
    assert driver.hold_a == driver.run_a


def test_a_fan_of_no_heater_is_told(tmp_path: Path) -> None:
    machine = load(tmp_path, PRINTER_CFG + "[heater_fan a]\npin: PF1\nheater:\n")
    (note,) = machine.notes
    assert "'heater' of [heater_fan a] names no heater, so the fan never runs" in note


def test_every_machine_has_an_idle_timeout(tmp_path: Path) -> None:
    machine = load(tmp_path, PRINTER_CFG)
    modules = build_modules(machine)
    idle = modules.find("idle_timeout", IdleTimeout)
    assert idle is not None
    assert idle.status()["idle_timeout"] == 600
    assert modules.knows("SET_IDLE_TIMEOUT")
    given = load(tmp_path, PRINTER_CFG + "[idle_timeout]\ntimeout: 60\n")
    (only,) = build_modules(given).of(IdleTimeout)
    assert only.status()["idle_timeout"] == 60


def test_two_nodes_with_one_placeholder_load(tmp_path: Path) -> None:
    text = "[mcu]\nserial: /dev/x\n[mcu z]\nserial: /dev/x\n[printer]\nkinematics: none\nmax_velocity: 1\n"
    assert len(load(tmp_path, text + "max_accel: 1\n").nodes) == 2


def test_includes_with_wildcards(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    for name, pin in (("b", "PF1"), ("a", "PF2")):
        (tmp_path / "parts" / f"{name}.cfg").write_text(f"[output_pin {name}]\npin: {pin}\n")
    machine = load(tmp_path, f"{PRINTER_CFG}[include parts/*.cfg]\n[include none/*.cfg]\n")
    assert [section for section in machine.modules.config if section.startswith("output_pin")] == [
        "output_pin a",
        "output_pin b",
    ]


EXTRA = """\
[mcu]
serial: /dev/ttyACM0
[printer]
kinematics: generic_cartesian
max_velocity: 300
max_accel: 3000
[carriage x]
position_endstop: 0
position_max: 300
endstop_pin: PA0
[carriage y]
position_endstop: 0
position_max: 300
endstop_pin: PA1
[extra_carriage y1]
primary_carriage: y
endstop_pin: PA2
[carriage z]
position_endstop: 0
position_max: 300
endstop_pin: PA3
"""


def motor(name: str, carriages: str, number: int) -> str:
    return (
        f"[stepper {name}]\ncarriages: {carriages}\nstep_pin: PB{2 * number}\ndir_pin: PB{2 * number + 1}\n"
        "microsteps: 16\nrotation_distance: 40\n"
    )


def test_an_extra_carriage_of_one_stepper_has_its_own_endstop(tmp_path: Path) -> None:
    names = (("a", "x"), ("b", "y"), ("c", "y1"), ("d", "z"))
    text = EXTRA + "".join(motor(*pair, number) for number, pair in enumerate(names))
    machine = load(tmp_path, text)
    assert machine.unsupported == ()
    y = next(rail for rail in machine.rails if rail.axis == "y")
    assert [(name, pin.name) for name, pin, _ in y.second_endstops] == [("c", "PA2")]


def test_an_extra_carriage_that_cannot_stop_by_itself_is_listed(tmp_path: Path) -> None:
    names = (("a", "x+y"), ("b", "y"), ("c", "y1"), ("d", "z"))
    text = EXTRA + "".join(motor(*pair, number) for number, pair in enumerate(names))
    assert waiting(load(tmp_path, text)) == {"extra_carriage y1": (("endstop_pin",), "")}


def test_a_sum_of_no_carriages_is_a_mistake_like_others(tmp_path: Path) -> None:
    names = (("a", "x++"), ("b", "y"), ("d", "z"))
    text = EXTRA + "".join(motor(*pair, number) for number, pair in enumerate(names))
    with pytest.raises(ConfigError, match="must be a sum of different carriages"):
        load(tmp_path, text)

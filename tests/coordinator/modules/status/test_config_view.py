"""Settings as macros read them: of the types that users of the peer know."""

from typing import Any

import pytest

from coordinator.modules.status.config_view import config_view
from tests.stages.printer_text import PRINTER_CFG
from tests.stages.program_stage import ProgramStage

SECTIONS = """
[probe]
pin: PB0
z_offset: 1
samples: 3
samples_result: Median
[bed_mesh]
mesh_min: 5, 6
mesh_max: 180,190
probe_count: 4
algorithm: Bicubic
fade_end: 10
[z_tilt]
z_positions:
    0, 1
    100,1
points:
    10,20
    100,20
[safe_z_home]
home_xy_position: 100, 100
[heater_bed]
heater_pin: PB1
sensor_pin: PB2
sensor_type: Generic 3950
control: watermark
min_temp: 0
max_temp: 120
[heater_fan hotend]
pin: !PB3
heater: heater_bed
[fan]
pin: PB4
kick_start_time: 1
hardware_pwm: no
[idle_timeout]
timeout: 300
[force_move]
enable_force_move: on
[screws_tilt_adjust]
screw1: 10, 20
screw1_name: 7
screw2: 180,20
screw3: 90,180
[servo door]
pin: 13
maximum_servo_angle: 90
[tmc5160 stepper_x]
cs_pin: PA9
run_current: 1
driver_TBL: 2
[adxl345]
cs_pin: 5
axes_map: x,-y, z
rate: 3200
[display_data _default a]
position: 0, 0
text: 0012
[gcode_macro PARK]
description: on
variable_x: 5
gcode:
    {% set y = 1 %}
"""
WANTED: dict[str, dict[str, Any]] = {
    "stepper_z": {"microsteps": 16, "rotation_distance": 8.0, "gear_ratio": [[3.0, 1.0], [20.0, 10.0]]},
    "stepper_y": {"gear_ratio": [], "full_steps_per_rotation": 200, "step_pin": "PA2"},
    "stepper_x": {
        "homing_speed": 5.0,
        "second_homing_speed": 2.5,
        "homing_retract_speed": 5.0,
        "homing_positive_dir": False,
        "position_min": 0.0,
    },
    "extruder": {"max_extrude_cross_section": 0.64, "pressure_advance_smooth_time": 0.04},
    "probe": {"lift_speed": 5.0, "samples": 3, "samples_result": "median", "z_offset": 1.0, "pin": "PB0"},
    "bed_mesh": {
        "mesh_min": [5.0, 6.0],
        "probe_count": [4, 4],
        "algorithm": "bicubic",
        "fade_end": 10.0,
        "mesh_pps": [2, 2],
    },
    "z_tilt": {"z_positions": [[0.0, 1.0], [100.0, 1.0]], "retries": 0},
    "safe_z_home": {"home_xy_position": [100.0, 100.0], "move_to_previous": False},
    "heater_bed": {"control": "watermark", "max_temp": 120.0, "sensor_type": "Generic 3950"},
    "heater_fan hotend": {"heater": ["heater_bed"], "pin": "!PB3", "heater_temp": 50.0},
    "fan": {"kick_start_time": 1.0, "hardware_pwm": False},
    "idle_timeout": {"timeout": 300.0},
    "force_move": {"enable_force_move": True},
    "screws_tilt_adjust": {"screw1": [10.0, 20.0], "screw1_name": "7"},
    "servo door": {"pin": "13", "maximum_servo_angle": 90.0},
    "tmc5160 stepper_x": {"run_current": 1.0, "driver_tbl": 2},
    "adxl345": {"cs_pin": "5", "axes_map": ["x", "-y", "z"], "rate": 3200},
    "gcode_macro park": {"description": "on", "variable_x": "5"},
    "mcu": {"canbus_uuid": "11aa22bb33cc"},
    "printer": {"kinematics": "corexy", "max_velocity": 300.0, "max_z_velocity": 300.0},
}


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> ProgramStage:
    text = PRINTER_CFG.replace("rotation_distance: 8\n", "rotation_distance: 8\ngear_ratio: 3:1, 20:10\n")
    text = text.replace("[stepper_z]", "[stepper_z]\nendstop_pin: probe:z_virtual_endstop")
    second = "[stepper_z1]\nstep_pin: PC4\ndir_pin: PC5\nmicrosteps: 16\nrotation_distance: 8\n"
    return ProgramStage(tmp_path_factory.mktemp("config"), SECTIONS + second, text)


def typed(value: object) -> object:
    """Return VALUE with the types of all numbers in it: 1, 1.0 and True are three things."""
    if isinstance(value, list):
        return [typed(each) for each in value]
    return type(value).__name__, round(value, 9) if isinstance(value, float) else value


def view(machine: ProgramStage, what: str) -> Any:
    return config_view(machine.modules.config, machine.modules.settings, {})[what]


@pytest.mark.parametrize("section", WANTED)
def test_settings_have_the_types_that_users_know(machine: ProgramStage, section: str) -> None:
    settings = view(machine, "settings")[section]
    found = {option: typed(settings.get(option)) for option in WANTED[section]}
    assert found == {option: typed(value) for option, value in WANTED[section].items()}


def test_the_configuration_is_text(machine: ProgramStage) -> None:
    config = view(machine, "config")
    assert config["gcode_macro PARK"]["variable_x"] == "5"
    assert {type(text) for options in config.values() for text in options.values()} == {str}

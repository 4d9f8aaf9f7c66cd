"""A small, complete configuration that tests spoil one line at a time."""

import re
from collections.abc import Mapping
from pathlib import Path

from coordinator.commands import DEMO_MACHINE, EXAMPLES

PRINTER_CFG = """\
[mcu]
canbus_uuid: 11aa22bb33cc

[mcu toolhead]
serial: /dev/ttyACM0

[printer]
kinematics: corexy
max_velocity: 300
max_accel: 5000

[stepper_x]
step_pin: PA0
dir_pin: PA1
microsteps: 16
rotation_distance: 40
position_max: 200

[stepper_y]
step_pin: PA2
dir_pin: PA3
microsteps: 16
rotation_distance: 40
position_max: 210

[stepper_z]
step_pin: PA4
dir_pin: PA5
microsteps: 16
rotation_distance: 8
position_max: 220

[extruder]
step_pin: toolhead:PA0
dir_pin: toolhead:PA1
microsteps: 16
rotation_distance: 22.5
nozzle_diameter: 0.4
filament_diameter: 1.75
"""

SENSORLESS_CFG = """
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

[stepper_x]
step_pin: PB0
dir_pin: PB1
enable_pin: !PC0
microsteps: 16
rotation_distance: 40
endstop_pin: tmc2209_stepper_x:virtual_endstop
position_endstop: 0
position_max: 250
homing_speed: 40
homing_retract_dist: 0

[tmc2209 stepper_x]
uart_pin: PD0
uart_address: 0
diag_pin: PE0
run_current: 0.8
hold_current: 0.5
home_current: 0.55
driver_SGTHRS: 70

[stepper_y]
step_pin: PB3
dir_pin: !PB4
enable_pin: !PC0
microsteps: 32
rotation_distance: 40
endstop_pin: tmc2209_stepper_y:virtual_endstop
position_endstop: 250
position_max: 250
homing_speed: 40
homing_retract_dist: 10
step_pulse_duration: 0

[tmc2209 stepper_y]
uart_pin: PD0
uart_address: 1
diag_pin: ^toolhead:PE1
run_current: 0.8
stealthchop_threshold: 30
interpolate: False
driver_SGTHRS: 70

[stepper_z]
step_pin: PB6
dir_pin: PB7
microsteps: 16
rotation_distance: 8
position_max: 250

[tmc2208 stepper_z]
uart_pin: PD2
tx_pin: PD3
run_current: 0.6
"""
"""Drivers that feel the ends of X and Y; one endstop is wired to the other node."""

SWITCHES_CFG = """
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
"""A switch on each axis; that of X is on the other node."""

DEMO_CFG = DEMO_MACHINE.read_text(encoding="utf-8")


def without_endstops(text: str = DEMO_CFG, changes: Mapping[str, str] | None = None) -> str:
    """Return a machine whose G28 takes its axes as home where they are; CHANGES: words by words."""
    text = re.sub(r"endstop_pin: .*\n", "", text)
    for old, new in (changes or {}).items():
        text = changed(old, new, text)
    return text


def write(folder: Path, text: str | bytes, name: str = "printer.cfg") -> str:
    """Write a file and return its path."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return str(path)


def changed(old: str, new: str, text: str = PRINTER_CFG) -> str:
    """Return the configuration with one place changed."""
    assert text.count(old) >= 1, old
    return text.replace(old, new, 1)


def example_text(name: str) -> str:
    """Return the text of an example machine."""
    return (EXAMPLES / f"{name}.cfg").read_text()

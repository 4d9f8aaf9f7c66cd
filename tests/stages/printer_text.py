"""A small, complete configuration that tests spoil one line at a time."""

import re
from collections.abc import Mapping
from pathlib import Path

from coordinator.support.examples import DEMO_MACHINE, EXAMPLES

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
"""Its lines are counted: tests spoil one at a time."""


def section(name: str, **options: object) -> str:
    """Return a section with its OPTIONS, a line each."""
    return "\n".join([f"[{name}]", *(f"{option}: {value}" for option, value in options.items()), "", ""])


def printer_section(kinematics: str = "cartesian", **options: object) -> str:
    """Return ``[printer]``; OPTIONS are added, or take the place of usual ones."""
    return section("printer", kinematics=kinematics, **{"max_velocity": 250, "max_accel": 3000} | options)


def stepper_section(name: str, step_pin: str, dir_pin: str, **options: object) -> str:
    """Return the section of stepper NAME, such as ``stepper_x``; with a belt unless OPTIONS say otherwise."""
    usual: dict[str, object] = {"microsteps": 16, "rotation_distance": 40}
    return section(name, step_pin=step_pin, dir_pin=dir_pin, **usual | options)


MCU = section("mcu", canbus_uuid="90a4ae022dfc", canbus_interface="can0")
TOOLHEAD = section("mcu toolhead", canbus_uuid="5e1ec7ab1e02", canbus_interface="can0")

SENSORLESS_CFG = (
    MCU
    + TOOLHEAD
    + printer_section()
    + stepper_section(
        "stepper_x",
        "PB0",
        "PB1",
        enable_pin="!PC0",
        endstop_pin="tmc2209_stepper_x:virtual_endstop",
        position_endstop=0,
        position_max=250,
        homing_speed=40,
        homing_retract_dist=0,
    )
    + section(
        "tmc2209 stepper_x",
        uart_pin="PD0",
        uart_address=0,
        diag_pin="PE0",
        run_current=0.8,
        hold_current=0.5,
        home_current=0.55,
        driver_SGTHRS=70,
    )
    + stepper_section(
        "stepper_y",
        "PB3",
        "!PB4",
        enable_pin="!PC0",
        microsteps=32,
        endstop_pin="tmc2209_stepper_y:virtual_endstop",
        position_endstop=250,
        position_max=250,
        homing_speed=40,
        homing_retract_dist=10,
        step_pulse_duration=0,
    )
    + section(
        "tmc2209 stepper_y",
        uart_pin="PD0",
        uart_address=1,
        diag_pin="^toolhead:PE1",
        run_current=0.8,
        stealthchop_threshold=30,
        interpolate=False,
        driver_SGTHRS=70,
    )
    + stepper_section("stepper_z", "PB6", "PB7", rotation_distance=8, position_max=250)
    + section("tmc2208 stepper_z", uart_pin="PD2", tx_pin="PD3", run_current=0.6)
)
"""Drivers that feel the ends of X and Y; one endstop is wired to the other node."""

SWITCHES_CFG = (
    MCU
    + TOOLHEAD
    + printer_section(max_z_velocity=20, max_z_accel=500)
    + stepper_section(
        "stepper_x",
        "PB0",
        "PB1",
        endstop_pin="^toolhead:PC5",
        position_endstop=0,
        position_max=250,
        homing_speed=50,
    )
    + stepper_section(
        "stepper_y",
        "PB3",
        "!PB4",
        endstop_pin="PC6",
        position_endstop=250,
        position_max=250,
        homing_speed=40,
        homing_retract_dist=3,
    )
    + stepper_section(
        "stepper_z",
        "PB6",
        "PB7",
        rotation_distance=8,
        endstop_pin="PC7",
        position_endstop=-0.5,
        position_min=-1,
        position_max=250,
        homing_speed=8,
        second_homing_speed=2,
    )
)
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

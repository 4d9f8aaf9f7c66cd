"""A small, complete configuration that tests spoil one line at a time."""

from pathlib import Path

from coordinator.commands import EXAMPLES

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

"""What it means for a print that something of the configuration does not act: the end of ``config check``."""

from collections.abc import Mapping
from typing import Final

from coordinator.config.model import Unsupported

_NO_PROBE: Final = "nothing is probed; an axis that it homes is refused by G28, lines that probe end a job"
_NO_LEVEL: Final = "the bed or the gantry stays as it is; lines that ask for this end a job"
_NO_DRIVER: Final = "its settings are not written: the motor may stand still, or have a wrong current"
_NO_CHIP: Final = "its pins do not act; what is on them is listed by itself"
_NO_LIGHT: Final = "no light; a print is as it would be"
_NO_SHOW: Final = "nothing is shown there; a print is as it would be"
_NO_MEASURING: Final = "nothing is measured; lines that move for it end a job"
_KINDS: Final[Mapping[str, str]] = {
    **dict.fromkeys(
        (
            *("probe", "bltouch", "smart_effector", "probe_eddy_current", "load_cell_probe"),
            *("dockable_probe", "z_calibration", "tools_calibrate"),
        ),
        _NO_PROBE,
    ),
    **dict.fromkeys(
        (
            *("bed_mesh", "bed_tilt", "bed_screws", "screws_tilt_adjust", "z_tilt", "z_tilt_ng"),
            *("quad_gantry_level", "z_thermal_adjust", "axis_twist_compensation", "delta_calibrate"),
        ),
        _NO_LEVEL,
    ),
    **dict.fromkeys(
        (
            *("tmc2130", "tmc2208", "tmc2209", "tmc2240", "tmc2660", "tmc5160", "autotune_tmc"),
            *("ad5206", "mcp4451", "mcp4728", "mcp4018", "dac084S085"),
        ),
        _NO_DRIVER,
    ),
    **dict.fromkeys(("multi_pin", "sx1509", "adc_scaled", "ads1x1x", "ads1118"), _NO_CHIP),
    "replicape": f"{_NO_CHIP}; motors that it switches on are not homed",
    **dict.fromkeys(("led", "neopixel", "dotstar", "pca9533", "pca9632", "led_effect"), _NO_LIGHT),
    **dict.fromkeys(("display", "display_data", "display_template", "display_glyph", "menu"), _NO_SHOW),
    **dict.fromkeys(
        (
            *("resonance_tester", "shaketune", "adxl345", "icm20948", "lis2dw", "lis3dh", "bmi160"),
            *("mpu9250", "angle", "load_cell"),
        ),
        _NO_MEASURING,
    ),
    **dict.fromkeys(
        ("filament_motion_sensor", "tsl1401cl_filament_width_sensor", "hall_filament_width_sensor"),
        "a job goes on when the filament fails",
    ),
    **dict.fromkeys(
        ("manual_stepper", "trad_rack", "belay"), "it stands still; lines that move it end a job"
    ),
    "servo": "it stands still; lines that move it end a job",
    "mixing_extruder": "all filament comes from one extruder; lines that mix end a job",
    **dict.fromkeys(
        ("extruder", "heater_bed", "heater_generic", "heated_fan"),
        "it does not heat, and lines that heat it end a job; filament is too cold to be moved",
    ),
    **dict.fromkeys(
        ("fan", "fan_generic", "heater_fan", "controller_fan", "temperature_fan"),
        "it stands still: what it should cool may get too hot",
    ),
    "homing_heaters": "heaters stay on while the machine homes",
    "verify_heater": "there is nothing to watch",
    "temperature_probe": "nothing is measured; a print is as it would be",
    "temperature_sensor": "nothing is measured there; a print is as it would be",
    **dict.fromkeys(
        ("output_pin", "pwm_tool", "pwm_cycle_time", "static_pwm_clock"), "the pin stays as the board has it"
    ),
    "dual_carriage": "it stands where it is, and its axis is refused by G28",
    "endstop_phase": "endstops are as exact as their switches",
    "gcode_shell_command": "RUN_SHELL_COMMAND is skipped with a notice",
    "sdcard_loop": "a job runs once; lines that loop end it",
    "canbus_stats": "a print is as it would be",
    "statistics": "a print is as it would be",
    "danger_options": "the usual checks hold",
    "constants": "values that refer to them are refused",
}
"""By the first word of a section of which nothing acts."""
_OPTIONS: Final[Mapping[str, str]] = {
    "enable_pin": "the motor cannot be switched on, and an axis that it moves is refused by G28",
    "endstop_pin": "an axis that has no other endstop is refused by G28",
    "max_angular_velocity": "near the middle the bed may be asked to turn faster",
    "homing_current": "the motor homes with run_current",
}
"""By an option."""
USUAL: Final = "it has no effect; a print is as it would be without it"


def meaning(entry: Unsupported) -> str:
    """Return what ENTRY means for a print, without a full stop."""
    if not entry.options:
        kind = entry.section.partition(" ")[0]
        return _KINDS.get(kind) or _KINDS.get(kind.rstrip("0123456789"), USUAL)
    known = [_OPTIONS[option] for option in entry.options if option in _OPTIONS]
    return "; ".join(dict.fromkeys(known)) or USUAL

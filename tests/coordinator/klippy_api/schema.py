"""Types and units of what clients read, object by object: section 6 of the peer's facts, as data."""

import math
from typing import Any, Final

NUMBER: Final = (int, float)
AXES: Final = "four numbers"
LAYERS: Final = "numbers of layers, or null"
TEXT_OR_NONE: Final = (str, type(None))
NUMBER_OR_NONE: Final = (int, float, type(None))

SCHEMA: Final[dict[str, dict[str, Any]]] = {
    "webhooks": {"state": str, "state_message": str},
    "configfile": {
        "config": dict,
        "settings": dict,
        "save_config_pending": bool,
        "save_config_pending_items": dict,
        "warnings": list,
    },
    "gcode": {"commands": dict},
    "mcu": {
        "mcu_version": str,
        "mcu_build_versions": str,
        "mcu_constants": dict,
        "app": str,
        "last_stats": dict,
    },
    "system_stats": {"sysload": NUMBER, "cputime": NUMBER, "memavail": NUMBER},
    "toolhead": {
        "homed_axes": str,
        "position": AXES,
        "axis_minimum": AXES,
        "axis_maximum": AXES,
        "max_velocity": NUMBER,
        "max_accel": NUMBER,
        "minimum_cruise_ratio": NUMBER,
        "square_corner_velocity": NUMBER,
        "extruder": str,
        "print_time": NUMBER,
        "estimated_print_time": NUMBER,
        "stalls": int,
        "extra_axes": dict,
    },
    "gcode_move": {
        "gcode_position": AXES,
        "position": AXES,
        "homing_origin": AXES,
        "speed": NUMBER,
        "speed_factor": NUMBER,
        "extrude_factor": NUMBER,
        "absolute_coordinates": bool,
        "absolute_extrude": bool,
        "axis_map": dict,
    },
    "motion_report": {
        "live_position": AXES,
        "live_velocity": NUMBER,
        "live_extruder_velocity": NUMBER,
        "steppers": list,
        "trapq": list,
    },
    "print_stats": {
        "state": str,
        "filename": str,
        "total_duration": NUMBER,
        "print_duration": NUMBER,
        "filament_used": NUMBER,
        "message": str,
        "info": LAYERS,
    },
    "virtual_sdcard": {
        "file_path": TEXT_OR_NONE,
        "progress": NUMBER,
        "is_active": bool,
        "file_position": int,
        "file_size": int,
    },
    "display_status": {"progress": NUMBER, "message": TEXT_OR_NONE},
    "pause_resume": {"is_paused": bool},
    "idle_timeout": {"state": str, "printing_time": NUMBER, "idle_timeout": NUMBER},
    "heaters": {"available_heaters": list, "available_sensors": list, "available_monitors": list},
    "extruder": {
        "temperature": NUMBER,
        "target": NUMBER,
        "power": NUMBER,
        "can_extrude": bool,
        "pressure_advance": NUMBER,
        "smooth_time": NUMBER,
        "motion_queue": TEXT_OR_NONE,
    },
    "heater_bed": {"temperature": NUMBER, "target": NUMBER, "power": NUMBER},
    "exclude_object": {"objects": list, "excluded_objects": list, "current_object": TEXT_OR_NONE},
    "stepper_enable": {"steppers": dict},
    "query_endstops": {"last_query": dict},
    "manual_probe": {
        "is_active": bool,
        "z_position": NUMBER_OR_NONE,
        "z_position_lower": NUMBER_OR_NONE,
        "z_position_upper": NUMBER_OR_NONE,
    },
    "heater_generic": {"temperature": NUMBER, "target": NUMBER, "power": NUMBER},
    "temperature_sensor": {
        "temperature": NUMBER,
        "measured_min_temp": NUMBER,
        "measured_max_temp": NUMBER,
    },
    "temperature_fan": {
        "speed": NUMBER,
        "rpm": NUMBER_OR_NONE,
        "temperature": NUMBER,
        "target": NUMBER,
    },
    "fan": {"speed": NUMBER, "rpm": NUMBER_OR_NONE},
    "fan_generic": {"speed": NUMBER, "rpm": NUMBER_OR_NONE},
    "heater_fan": {"speed": NUMBER, "rpm": NUMBER_OR_NONE},
    "controller_fan": {"speed": NUMBER, "rpm": NUMBER_OR_NONE},
    "output_pin": {"value": NUMBER},
    "filament_switch_sensor": {"enabled": bool, "filament_detected": bool},
    "firmware_retraction": {
        "retract_length": NUMBER,
        "retract_speed": NUMBER,
        "unretract_extra_length": NUMBER,
        "unretract_speed": NUMBER,
    },
    "tmc2209": {
        "run_current": NUMBER,
        "hold_current": NUMBER,
        "drv_status": (dict, type(None)),
        "temperature": NUMBER_OR_NONE,
        "mcu_phase_offset": (int, type(None)),
        "phase_offset_position": NUMBER_OR_NONE,
    },
    "save_variables": {"variables": dict},
    "bed_mesh": {
        "profile_name": str,
        "mesh_min": list,
        "mesh_max": list,
        "probed_matrix": list,
        "mesh_matrix": list,
        "profiles": dict,
    },
    "probe": {"name": str, "last_query": bool, "last_z_result": NUMBER},
    "screws_tilt_adjust": {"error": bool, "max_deviation": NUMBER_OR_NONE, "results": dict},
    "bed_screws": {
        "is_active": bool,
        "state": TEXT_OR_NONE,
        "current_screw": (int, type(None)),
        "accepted_screws": (int, type(None)),
    },
}
"""By object and field: the type, or AXES; ``fan_generic`` stands for all objects whose first word it is."""

SECTIONS: Final = """
[heater_generic chamber]
heater_pin: PF2
sensor_type: Generic 3950
sensor_pin: PF3
control: watermark
min_temp: 0
max_temp: 90
[temperature_sensor board]
sensor_type: Generic 3950
sensor_pin: PF1
min_temp: 0
max_temp: 100
[temperature_fan exhaust]
pin: PF4
sensor_type: Generic 3950
sensor_pin: PF5
control: watermark
target_temp: 40
min_temp: 0
max_temp: 90
[fan_generic shelf]
pin: PF6
[controller_fan electronics]
pin: PF8
[output_pin caselight]
pin: PF9
[filament_switch_sensor runout]
switch_pin: PF10
[firmware_retraction]
[save_variables]
filename: {folder}/variables.cfg
[probe]
pin: PF11
z_offset: 1
[screws_tilt_adjust]
screw1: 10, 10
screw2: 100, 10
screw3: 50, 100
[bed_screws]
screw1: 10, 10
screw2: 100, 10
screw3: 50, 100
"""
"""What a machine that prints needs beyond its own to have all objects of SCHEMA."""

STATS: Final = frozenset(
    (
        *("mcu_awake", "mcu_task_avg", "mcu_task_stddev", "freq", "bytes_write", "bytes_read"),
        *("bytes_retransmit", "bytes_invalid", "srtt", "rto", "ready_bytes", "send_seq"),
    )
)
"""Numbers in ``last_stats`` of each node."""


def problems(status: dict[str, dict[str, Any]]) -> list[str]:
    """Return what STATUS has otherwise than SCHEMA."""
    found = []
    for kind, fields in SCHEMA.items():
        names = [name for name in status if name.partition(" ")[0] == kind]
        if not names:
            found.append(f"there is no {kind}")
        for name in names:
            found += [
                f"{name}.{field} is {status[name].get(field, 'missing')!r}"
                for field, expected in fields.items()
                if field not in status[name] or not _fits(status[name][field], expected)
            ]
        if kind == "mcu":
            found += [
                f"{name} has no {STATS - s.keys()}"
                for name in names
                if STATS - (s := _stats(status[name])).keys()
            ]
    return found


def _stats(node: dict[str, Any]) -> dict[str, Any]:
    """Return the statistics of NODE that are numbers."""
    return {name: value for name, value in node["last_stats"].items() if _fits(value, NUMBER)}


def _fits(value: Any, expected: Any) -> bool:
    if expected is AXES:
        return isinstance(value, list) and len(value) == 4 and all(_fits(item, NUMBER) for item in value)
    if expected is LAYERS:
        return value.keys() == {"total_layer", "current_layer"} and all(
            _fits(item, (int, type(None))) for item in value.values()
        )
    if isinstance(value, bool):
        return expected is bool
    if isinstance(value, float):
        return isinstance(value, expected) and math.isfinite(value)
    return isinstance(value, expected)

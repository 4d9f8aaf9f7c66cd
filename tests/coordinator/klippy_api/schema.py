"""Types and units of what clients read, object by object: section 6 of the peer's facts, as data."""

from typing import Any, Final

NUMBER: Final = (int, float)
AXES: Final = "four numbers"
TEXT_OR_NONE: Final = (str, type(None))

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
        "info": dict,
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
    "manual_probe": {"is_active": bool},
}
"""By object and field: the type, or AXES. A machine has the objects whose sections it has."""

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
    for name, fields in SCHEMA.items():
        for field, kind in fields.items():
            if field not in status.get(name, {}):
                found.append(f"{name}.{field} is missing")
                continue
            value = status[name][field]
            good = _is_position(value) if kind is AXES else isinstance(value, kind)
            if not good:
                found.append(f"{name}.{field} is {value!r}")
    return found


def _is_position(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 4 and all(isinstance(item, NUMBER) for item in value)

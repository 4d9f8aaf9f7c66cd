"""What macros see of sections that nothing acts on: what they would be with nothing done yet.

No place or temperature is made up: nothing is level, probed, on or hot.
"""

from collections.abc import Callable, Mapping
from typing import Any, Final

Status = Mapping[str, Any]


def _probe() -> Status:
    place = [0.0, 0.0, 0.0]
    return {"name": "probe", "last_query": False, "last_probe_position": place, "last_z_result": 0.0}


_NO_TEMPERATURES: Final = {"temperature": 0.0, "measured_min_temp": 0.0, "measured_max_temp": 0.0}
_KINDS: Final[Mapping[str, Callable[[], Status]]] = {
    "bed_mesh": lambda: {
        "profile_name": "",
        "mesh_min": [0.0, 0.0],
        "mesh_max": [0.0, 0.0],
        "probed_matrix": [[]],
        "mesh_matrix": [[]],
        "profiles": {},
    },
    **dict.fromkeys(("z_tilt", "z_tilt_ng", "quad_gantry_level"), lambda: {"applied": False}),
    **dict.fromkeys(
        ("probe", "bltouch", "smart_effector", "probe_eddy_current", "dockable_probe"),
        _probe,
    ),
    "load_cell_probe": lambda: {
        **_probe(),
        "endstop_tare_counts": None,
        "last_trigger_time": None,
        "is_last_tap_valid": False,
    },
    **dict.fromkeys(
        ("led", "neopixel", "dotstar", "pca9533", "pca9632"), lambda: {"color_data": [[0.0, 0.0, 0.0, 0.0]]}
    ),
    "bed_screws": lambda: {
        "is_active": False,
        "state": None,
        "current_screw": None,
        "accepted_screws": None,
    },
    "screws_tilt_adjust": lambda: {"error": False, "max_deviation": None, "results": {}},
    "z_thermal_adjust": lambda: {
        "enabled": False,
        "current_z_adjust": 0.0,
        "z_adjust_ref_temperature": 0.0,
        **_NO_TEMPERATURES,
    },
    **dict.fromkeys(("temperature_probe", "temperature_combined"), lambda: {**_NO_TEMPERATURES}),
    "angle": lambda: {"temperature": None},
    "canbus_stats": lambda: {"rx_error": None, "tx_error": None, "tx_retries": None, "bus_state": None},
    "load_cell": lambda: {
        "is_calibrated": False,
        "counts_per_gram": None,
        "reference_tare_counts": None,
        "tare_counts": None,
        "force_g": None,
        "min_force_g": None,
        "max_force_g": None,
        "errors": 0,
        "overflows": 0,
        "sample_rate": 0.0,
    },
    **dict.fromkeys(("servo", "pwm_tool", "pwm_cycle_time", "output_pin"), lambda: {"value": 0.0}),
    "filament_motion_sensor": lambda: {"enabled": False, "filament_detected": False},
    **dict.fromkeys(
        ("hall_filament_width_sensor", "tsl1401cl_filament_width_sensor"),
        lambda: {"is_active": False, "flow_compensation_enabled": False, "Diameter": 0.0, "Raw": 0},
    ),
    "palette2": lambda: {"ping": None, "remaining_load_length": None, "is_splicing": False},
    "endstop_phase": lambda: {"last_home": {}},
    "manual_stepper": lambda: {"enabled": False},
    "extruder": lambda: {"temperature": 0.0, "target": 0.0, "power": 0.0, "can_extrude": False},
    **dict.fromkeys(
        ("heater_bed", "heater_generic"), lambda: {"temperature": 0.0, "target": 0.0, "power": 0.0}
    ),
    "temperature_sensor": lambda: {**_NO_TEMPERATURES},
    "temperature_fan": lambda: {"temperature": 0.0, "target": 0.0, "speed": 0.0, "rpm": None},
    **dict.fromkeys(
        ("fan", "fan_generic", "heater_fan", "controller_fan"), lambda: {"speed": 0.0, "rpm": None}
    ),
}
"""By the first word of the section."""


def absent_status(section: str) -> Status:
    """Return what macros see of SECTION, on which nothing acts."""
    kind = section.partition(" ")[0]
    make = _KINDS.get(kind) or _KINDS.get(kind.rstrip("0123456789"))
    return {} if make is None else make()


def absent_statuses(sections: Mapping[str, object]) -> dict[str, Status]:
    """Return it for all SECTIONS by name; whatever probe there is, macros know it as ``probe``."""
    found = {section: absent_status(section) for section in sections}
    probe = next((name for name, status in found.items() if "last_z_result" in status), None)
    if probe is not None:
        found.setdefault("probe", found[probe])
    return {name: status for name, status in found.items() if status}

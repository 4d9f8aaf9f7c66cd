"""Commands of other hosts that are not supported here: which section brings them, what they would do.

A line that would move, heat or level something and is skipped leaves a print that is not what its file says:
where the configuration has a section for it, it is an error in a job. What only shows, lights or measures is
skipped with a notice, as is any unknown command, and any for which the machine has no section.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final


class Effect(Enum):
    """What a command does to a print; the value continues after the command's name."""

    MOVES = "moves something"
    HEATS = "heats something"
    LEVELS = "measures or corrects where the bed is"
    NONE = "does nothing to a print"
    """Lights, displays, measurements that are only reported."""


@dataclass(frozen=True, slots=True)
class AbsentCommand:
    """One of them."""

    sections: tuple[str, ...]
    """First words of the sections that bring it; none: no section does."""
    effect: Effect

    @property
    def harmless(self) -> bool:
        """Whether a job may go on without it."""
        return self.effect is Effect.NONE


_PROBES: Final = (
    *("bltouch", "smart_effector", "probe_eddy_current", "load_cell_probe", "dockable_probe"),
    *("cartographer", "beacon", "scanner"),
)
_WIDTH_SENSORS: Final = ("hall_filament_width_sensor", "tsl1401cl_filament_width_sensor")
_ACCELEROMETERS: Final = (
    *("adxl345", "lis2dw", "lis3dh", "mpu9250", "icm20948", "bmi160", "resonance_tester"),
)
_LEDS: Final = ("neopixel", "dotstar", "led", "pca9533", "pca9632", "led_effect")
_SPI_DRIVERS: Final = ("tmc2130", "tmc5160", "tmc2240", "tmc2660")
_TABLE: Final[tuple[tuple[Effect, tuple[str, ...], str], ...]] = (
    (
        Effect.LEVELS,
        ("bed_mesh",),
        "BED_MESH_CALIBRATE BED_MESH_PROFILE BED_MESH_OFFSET BED_MESH_CHECK",
    ),
    (Effect.NONE, ("bed_mesh",), "BED_MESH_CLEAR BED_MESH_MAP BED_MESH_OUTPUT"),
    (Effect.LEVELS, ("z_tilt", "z_tilt_ng"), "Z_TILT_ADJUST"),
    (Effect.LEVELS, ("z_tilt_ng",), "Z_TILT_CALIBRATE Z_TILT_AUTODETECT"),
    (Effect.LEVELS, ("quad_gantry_level",), "QUAD_GANTRY_LEVEL"),
    (Effect.LEVELS, ("bed_tilt",), "BED_TILT_CALIBRATE"),
    (Effect.LEVELS, ("screws_tilt_adjust",), "SCREWS_TILT_CALCULATE"),
    (Effect.LEVELS, ("delta_calibrate",), "DELTA_CALIBRATE DELTA_ANALYZE"),
    (Effect.LEVELS, ("axis_twist_compensation",), "AXIS_TWIST_COMPENSATION_CALIBRATE"),
    (Effect.LEVELS, ("z_calibration",), "CALIBRATE_Z PROBE_Z_ACCURACY CALCULATE_SWITCH_OFFSET"),
    (Effect.LEVELS, ("z_thermal_adjust",), "SET_Z_THERMAL_ADJUST"),
    (
        Effect.LEVELS,
        ("probe", *_PROBES),
        "PROBE PROBE_ACCURACY PROBE_CALIBRATE Z_OFFSET_APPLY_PROBE",
    ),
    (
        Effect.LEVELS,
        _PROBES,
        (
            "PROBE_EDDY_CURRENT_CALIBRATE PROBE_EDDY_CURRENT_TAP_CALIBRATE ATTACH_PROBE DETACH_PROBE"
            " SET_DOCKABLE_PROBE MOVE_TO_APPROACH_PROBE MOVE_TO_DOCK_PROBE MOVE_TO_EXTRACT_PROBE"
            " MOVE_TO_INSERT_PROBE MOVE_TO_DETACH_PROBE MOVE_AVOIDING_DOCK BLTOUCH_DEBUG BLTOUCH_STORE"
            " SET_SMART_EFFECTOR RESET_SMART_EFFECTOR"
        ),
    ),
    (Effect.NONE, ("probe", *_PROBES), "QUERY_PROBE"),
    (Effect.NONE, _PROBES, "QUERY_DOCKABLE_PROBE"),
    (
        Effect.LEVELS,
        ("bed_mesh", "z_tilt_ng", "bed_tilt", "delta_calibrate"),
        "G29 G32 G33 G34",
    ),
    (Effect.MOVES, ("manual_stepper",), "MANUAL_STEPPER"),
    (Effect.MOVES, ("servo",), "SET_SERVO"),
    (Effect.MOVES, _SPI_DRIVERS, "SET_TMC_CURRENT SET_TMC_FIELD INIT_TMC"),
    (Effect.NONE, _SPI_DRIVERS, "DUMP_TMC"),
    (Effect.MOVES, ("mcp4451", "mcp4728", "mcp4018", "ad5206"), "SET_DIGIPOT"),
    (Effect.MOVES, ("endstop_phase",), "ENDSTOP_PHASE_CALIBRATE"),
    (Effect.MOVES, ("load_cell_probe", "load_cell"), "LOAD_CELL_TEST_TAP"),
    (
        Effect.NONE,
        ("load_cell_probe", "load_cell"),
        "LOAD_CELL_CALIBRATE LOAD_CELL_DIAGNOSTIC LOAD_CELL_READ LOAD_CELL_TARE",
    ),
    (Effect.MOVES, ("angle",), "ANGLE_CALIBRATE ANGLE_CHIP_CALIBRATE"),
    (Effect.NONE, ("angle",), "ANGLE_DEBUG_READ ANGLE_DEBUG_WRITE"),
    (Effect.MOVES, ("resonance_tester",), "TEST_RESONANCES SHAPER_CALIBRATE"),
    (
        Effect.NONE,
        _ACCELEROMETERS,
        (
            "ACCELEROMETER_MEASURE ACCELEROMETER_QUERY ACCELEROMETER_DEBUG_READ ACCELEROMETER_DEBUG_WRITE"
            " MEASURE_AXES_NOISE"
        ),
    ),
    (Effect.MOVES, ("palette2",), "PALETTE_CONNECT PALETTE_CUT PALETTE_SMART_LOAD"),
    (Effect.NONE, ("palette2",), "PALETTE_CLEAR PALETTE_DISCONNECT"),
    (Effect.MOVES, ("sdcard_loop",), "SDCARD_LOOP_BEGIN SDCARD_LOOP_END SDCARD_LOOP_DESIST"),
    (
        Effect.MOVES,
        ("trad_rack",),
        (
            "TR_HOME TR_GO_TO_LANE TR_LOAD_LANE TR_LOAD_TOOLHEAD TR_UNLOAD_TOOLHEAD TR_RESUME TR_SERVO_DOWN"
            " TR_SERVO_UP TR_SERVO_TEST TR_NEXT TR_SYNC_TO_EXTRUDER TR_UNSYNC_FROM_EXTRUDER"
            " TR_LOCATE_SELECTOR TR_CALIBRATE_SELECTOR TR_SET_ACTIVE_LANE TR_RESET_ACTIVE_LANE"
            " TR_SET_DEFAULT_LANE TR_SET_HOTEND_LOAD_LENGTH TR_DISCARD_BOWDEN_LENGTHS TR_RESET_TOOL_MAP"
        ),
    ),
    (Effect.NONE, ("trad_rack",), "TR_PRINT_TOOL_MAP TR_PRINT_TOOL_GROUPS"),
    (Effect.MOVES, ("tools_calibrate",), "TOOL_LOCATE_SENSOR TOOL_CALIBRATE_TOOL_OFFSET"),
    (
        Effect.NONE,
        ("tools_calibrate",),
        "TOOL_CALIBRATE_QUERY_PROBE TOOL_CALIBRATE_SAVE_TOOL_OFFSET",
    ),
    (Effect.MOVES, ("mixing_extruder",), "M163 M164 M567 SET_MIXING_EXTRUDER SAVE_MIXING_EXTRUDERS"),
    (Effect.MOVES, ("belay",), "BELAY_ENABLE BELAY_DISABLE BELAY_SET_STEPPER"),
    (Effect.NONE, ("belay",), "QUERY_BELAY"),
    (Effect.MOVES, ("indx",), "INDX_EXTRUDER_MOVE INDX_DOCK_MEASURE INDX_CLEAR_FILAMENT"),
    (
        Effect.HEATS,
        ("indx",),
        "INDX_SET_PID INDX_SET_CYCLE_LIMIT INDX_MEASURE_POWER INDX_FORCE_BRACKET_TEMP",
    ),
    (
        Effect.NONE,
        ("indx",),
        (
            "INDX_LOG INDX_LED_SET_CURRENT INDX_DUMP_MODEL_UPDATE INDX_DEBUG_IR_SENSOR_EEPROM"
            " INDX_DEBUG_STREAM_RAW_IR_SENSOR"
        ),
    ),
    (Effect.HEATS, ("heated_fan",), "SET_HEATED_FAN_TARGET"),
    (Effect.HEATS, ("heater_bed",), "M140 M190"),
    (Effect.HEATS, ("extruder",), "M104 M109"),
    (Effect.NONE, ("temperature_fan",), "SET_TEMPERATURE_FAN_TARGET"),
    (
        Effect.HEATS,
        ("extruder", "heater_bed", "heater_generic"),
        "SET_HEATER_TEMPERATURE TEMPERATURE_WAIT PID_CALIBRATE MPC_CALIBRATE",
    ),
    (Effect.NONE, ("fan",), "M106 M107"),
    (Effect.NONE, ("fan_generic",), "SET_FAN_SPEED"),
    (Effect.MOVES, ("output_pin", "pwm_tool", "pwm_cycle_time"), "SET_PIN"),
    (
        Effect.NONE,
        _WIDTH_SENSORS,
        (
            "QUERY_FILAMENT_WIDTH QUERY_RAW_FILAMENT_WIDTH RESET_FILAMENT_WIDTH_SENSOR"
            " ENABLE_FILAMENT_WIDTH_LOG DISABLE_FILAMENT_WIDTH_LOG ENABLE_FILAMENT_WIDTH_SENSOR"
            " DISABLE_FILAMENT_WIDTH_SENSOR"
        ),
    ),
    (Effect.NONE, _LEDS, "SET_LED SET_LED_TEMPLATE SET_LED_EFFECT STOP_LED_EFFECTS"),
    (Effect.NONE, ("display", "display_data"), "SET_DISPLAY_GROUP SET_DISPLAY_TEXT"),
    (
        Effect.NONE,
        ("temperature_probe",),
        (
            "TEMPERATURE_PROBE_CALIBRATE TEMPERATURE_PROBE_NEXT TEMPERATURE_PROBE_COMPLETE"
            " TEMPERATURE_PROBE_ENABLE"
        ),
    ),
    (Effect.NONE, ("gcode_shell_command",), "RUN_SHELL_COMMAND"),
    (Effect.NONE, ("filament_motion_sensor",), "QUERY_FILAMENT_SENSOR SET_FILAMENT_SENSOR"),
    (Effect.NONE, (), "LOG_ROLLOVER RELOAD_GCODE_MACROS"),
)


def _by_name() -> dict[str, AbsentCommand]:
    return {
        name: AbsentCommand(sections, effect) for effect, sections, names in _TABLE for name in names.split()
    }


ABSENT: Final[Mapping[str, AbsentCommand]] = _by_name()
"""By name. Some of them are known where a section of theirs acts: then this table is not asked."""

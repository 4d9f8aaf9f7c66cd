"""The options of a heater, wherever a section has one."""

from typing import Any, Final

from coordinator.config.options import ChoiceOption, FloatOption, Option, TextOption
from coordinator.config.pins import PinOption
from coordinator.config.sections.sensor_options import SENSOR_OPTIONS, UNSUPPORTED_SENSOR_OPTIONS

HEATER_PIN: Final = PinOption(name="heater_pin", help="output that switches the heater")
MAX_POWER: Final = FloatOption(
    name="max_power",
    help="highest share of full power that is ever used",
    default=1.0,
    above=0,
    maximum=1,
)
CYCLE_TIME: Final = FloatOption(
    name="pwm_cycle_time",
    help="period of its PWM",
    default=0.1,
    unit="s",
    minimum=0.001,
    maximum=5,
)
MAX_DURATION: Final = FloatOption(
    name="max_duration",
    help="how long the node keeps the heater on without hearing from the host; then it stops by itself",
    default=1.5,
    unit="s",
    minimum=1.0,
    maximum=5.0,
)
CONTROL: Final = ChoiceOption(
    name="control",
    help="how the temperature is held: by PID, by switching on and off, or by a model of the heater",
    default="watermark",
    choices=("pid", "watermark", "mpc"),
    unsupported=("pid_v", "pi", "dual_loop_pid", "curve"),
)
MAX_DELTA: Final = FloatOption(
    name="max_delta",
    help="watermark control: hysteresis above and below the target",
    default=2.0,
    unit="K",
    above=0,
    maximum=50,
)
SMOOTH_TIME: Final = FloatOption(
    name="smooth_time",
    help="time over which the slope of the temperature is smoothed",
    default=1.0,
    unit="s",
    above=0,
    maximum=60,
)


def _gain(letter: str, what: str, unit: str) -> FloatOption:
    return FloatOption(
        name=f"pid_k{letter}",
        help=f"PID: power (255 is full) per {what}; from PID_CALIBRATE",
        unit=unit,
        minimum=0,
        maximum=1_000_000,
    )


PID_KP: Final = _gain("p", "K of error", "1/K")
PID_KI: Final = _gain("i", "K of error and s", "1/(K·s)")
PID_KD: Final = _gain("d", "K per s", "s/K")
HEATER_POWER: Final = FloatOption(
    name="heater_power", help="MPC: power of the heater when fully on", unit="W", above=0, maximum=50_000
)
BLOCK_HEAT_CAPACITY: Final = FloatOption(
    name="block_heat_capacity",
    help="MPC: heat capacity of the heated block; from MPC_CALIBRATE",
    unit="J/K",
    above=0,
    maximum=1_000_000,
)
AMBIENT_TRANSFER: Final = FloatOption(
    name="ambient_transfer",
    help="MPC: loss to the surroundings without fan; from MPC_CALIBRATE",
    unit="W/K",
    above=0,
    maximum=10_000,
)
SENSOR_RESPONSIVENESS: Final = FloatOption(
    name="sensor_responsiveness",
    help="MPC: how fast the sensor follows the block; from MPC_CALIBRATE",
    unit="K/s/K",
    above=0,
    maximum=100,
)
TARGET_REACH_TIME: Final = FloatOption(
    name="target_reach_time",
    help="MPC: how far ahead the power is calculated",
    default=2.0,
    unit="s",
    above=0,
    maximum=60,
)
STEADY_STATE_RATE: Final = FloatOption(
    name="steady_state_rate",
    help="MPC: while the temperature changes more slowly than this, unexplained heat is learned",
    default=0.5,
    unit="K/s",
    above=0,
    maximum=10,
)
COOLING_FAN: Final = TextOption(
    name="cooling_fan",
    help="MPC: section of the fan that cools the block",
    pattern_rule="the name of a fan's section, as in fan or fan_generic NAME",
)
FAN_TRANSFER: Final = TextOption(
    name="fan_ambient_transfer",
    help="MPC: losses in W/K with that fan at speeds spread evenly from 0 to 1; from MPC_CALIBRATE",
    pattern=r"\s*\d*\.?\d+(\s*,\s*\d*\.?\d+)+\s*",
    pattern_rule="two or more numbers separated by commas",
)
AMBIENT_SENSOR: Final = TextOption(
    name="ambient_temp_sensor",
    help="MPC: section of a sensor for the temperature around the heater",
    pattern_rule="the name of a sensor's section, as in temperature_sensor NAME",
)
PID_OPTIONS: Final[tuple[Option[float], ...]] = (PID_KP, PID_KI, PID_KD)
MPC_OPTIONS: Final[tuple[Option[float], ...]] = (
    HEATER_POWER,
    BLOCK_HEAT_CAPACITY,
    AMBIENT_TRANSFER,
    SENSOR_RESPONSIVENESS,
    TARGET_REACH_TIME,
    STEADY_STATE_RATE,
)
HEATER_OPTIONS: Final[tuple[Option[Any], ...]] = (
    HEATER_PIN,
    *SENSOR_OPTIONS,
    MAX_POWER,
    CONTROL,
    *PID_OPTIONS,
    SMOOTH_TIME,
    MAX_DELTA,
    *MPC_OPTIONS,
    COOLING_FAN,
    FAN_TRANSFER,
    AMBIENT_SENSOR,
    CYCLE_TIME,
    MAX_DURATION,
)
UNSUPPORTED_HEATER_OPTIONS: Final = (
    *UNSUPPORTED_SENSOR_OPTIONS,
    "pid_version",
    "pid_tolerance",
    "min_ambient_change",
    "lost_update_tolerance",
    *("inner_sensor_name", "inner_target_temp", "inner_max_temp"),
    *("inner_pid_kp", "inner_pid_ki", "inner_pid_kd"),
)
MIN_EXTRUDE_TEMP: Final = FloatOption(
    name="min_extrude_temp",
    help="filament is not moved while the extruder is colder than this",
    default=170.0,
    unit="°C",
    minimum=-273.15,
    maximum=1500,
)
FILAMENT_DENSITY: Final = FloatOption(
    name="filament_density",
    help="MPC: of the filament, whose heat is taken into account; 0: it is not",
    default=1.2,
    unit="g/cm³",
    minimum=0,
    maximum=25,
)
FILAMENT_HEAT_CAPACITY: Final = FloatOption(
    name="filament_heat_capacity",
    help="MPC: of the filament",
    default=1.8,
    unit="J/(g·K)",
    minimum=0,
    maximum=10,
)
EXTRUDER_HEATER_OPTIONS: Final[tuple[Option[Any], ...]] = (
    *HEATER_OPTIONS,
    MIN_EXTRUDE_TEMP,
    FILAMENT_DENSITY,
    FILAMENT_HEAT_CAPACITY,
)

"""The options of sections for stepper drivers, and the registers that follow from them."""

from typing import Any, Final

from coordinator.config.errors import ConfigError
from coordinator.config.model import StepperDescription
from coordinator.config.options import BoolOption, FloatOption, IntOption, Option, SectionSpec
from coordinator.config.pins import PinOption
from coordinator.drivers.tmc_chips import Chip, Field
from coordinator.drivers.tmc_formulas import Currents, currents, largest_current, tstep
from coordinator.modules.base import Build

MAX_CURRENT_A: Final = 2.0
"""RMS; no chip of these carries more."""
MAX_SPEED: Final = 1e9
"""mm/s; users write 999999 for a speed that is never reached."""

UART_PIN: Final = PinOption(
    name="uart_pin", help="the driver's PDN_UART", invertible=False, pullable=True, share="tmc_uart"
)
TX_PIN: Final = PinOption(
    name="tx_pin",
    help="output to the driver, where that is not uart_pin",
    invertible=False,
    share="tmc_tx",
)
UART_ADDRESS: Final = IntOption(
    name="uart_address", help="as the driver's MS1 and MS2 are wired", default=0, minimum=0, maximum=3
)
ONLY_UART_ADDRESS: Final = IntOption(
    name="uart_address", help="this driver has no other address", default=0, minimum=0, maximum=0
)


def _current(name: str, text: str) -> FloatOption:
    return FloatOption(name=name, help=text, unit="A", above=0, maximum=MAX_CURRENT_A)


RUN_CURRENT: Final = _current("run_current", "current while the motor moves, RMS")
HOLD_CURRENT: Final = _current("hold_current", "current at standstill, RMS; by default run_current")
HOME_CURRENT: Final = _current(
    "home_current", "current during sensorless homing, RMS; by default run_current"
)
SENSE_RESISTOR: Final = FloatOption(
    name="sense_resistor",
    help="the driver's sense resistors",
    default=0.11,
    unit="ohm",
    minimum=0.01,
    maximum=1,
)
INTERPOLATE: Final = BoolOption(
    name="interpolate", help="have the driver interpolate to 256 microsteps", default=True
)
STEALTHCHOP: Final = FloatOption(
    name="stealthchop_threshold",
    help="below this speed the driver is in StealthChop, above it in SpreadCycle; 0: always in SpreadCycle",
    default=0.0,
    unit="mm/s",
    minimum=0,
    maximum=MAX_SPEED,
)
COOLSTEP: Final = FloatOption(
    name="coolstep_threshold",
    help="above this speed StallGuard and CoolStep act; by default they do while homing only, from half of"
    " its speed on",
    unit="mm/s",
    above=0,
    maximum=MAX_SPEED,
)
DIAG_PIN: Final = PinOption(
    name="diag_pin",
    help="input, of any node, for the driver's DIAG; in use where an endstop_pin names its virtual endstop",
    pullable=True,
    share="endstop",
)

_BOOLEANS: Final = ("multistep_filt", "pwm_autoscale", "pwm_autograd")
_DRIVER_FIELDS: Final = {
    "MULTISTEP_FILT": 1,
    "IHOLDDELAY": 8,
    "TPOWERDOWN": 20,
    "TBL": 2,
    "TOFF": 3,
    "HEND": 0,
    "HSTRT": 5,
    "PWM_AUTOGRAD": 1,
    "PWM_AUTOSCALE": 1,
    "PWM_LIM": 12,
    "PWM_REG": 8,
    "PWM_FREQ": 1,
    "FREEWHEEL": 0,
    "PWM_GRAD": 14,
    "PWM_OFS": 36,
}
"""With their defaults: those of the data sheets' quick start for steppers of printers."""
_STALL_FIELDS: Final = {"SGTHRS": 0, "SEMIN": 0, "SEUP": 0, "SEMAX": 0, "SEDN": 0, "SEIMIN": 0}
_HELP: Final = {
    "SGTHRS": "sensitivity of StallGuard: 0 lowest, 255 highest",
    "TOFF": "chopper off time; 0 would switch the driver off",
}
_PREFIX: Final = "driver_"


def _field_option(field: Field, name: str, default: int) -> Option[Any]:
    text = _HELP.get(name, f"field {name} of the driver, see its data sheet")
    if field.name in _BOOLEANS:
        return BoolOption(name=_PREFIX + field.name, help=text, default=bool(default))
    low = 1 if name == "TOFF" else 0
    return IntOption(
        name=_PREFIX + field.name, help=text, default=default, minimum=low, maximum=field.maximum
    )


def field_options(chip: Chip) -> dict[str, Option[Any]]:
    """Return the options for a chip's fields, by field."""
    names = _DRIVER_FIELDS | (_STALL_FIELDS if chip.has_stallguard else {})
    found: dict[str, Option[Any]] = {}
    for name, default in names.items():
        register = chip.field_register(name)
        assert register is not None, name
        found[name.lower()] = _field_option(register.field(name.lower()), name, default)
    return found


def driver_spec(chip: Chip) -> SectionSpec:
    """Return all options of [CHIP STEPPER]."""
    more: tuple[Option[Any], ...] = (ONLY_UART_ADDRESS,)
    if chip.has_stallguard:
        more = (UART_ADDRESS, HOME_CURRENT, COOLSTEP, DIAG_PIN)
    return SectionSpec(
        help=f"The driver {chip.name.upper()} of a stepper, which is set by its UART: see tmc.md",
        options=(
            *(UART_PIN, TX_PIN, RUN_CURRENT, HOLD_CURRENT, SENSE_RESISTOR, INTERPOLATE, STEALTHCHOP),
            *more,
            *field_options(chip).values(),
        ),
        unsupported=(
            *("select_pins", "current_change_dwell_time"),
            *(() if chip.has_stallguard else ("home_current",)),
        ),
    )


class DriverSettings:
    """What a section says about the driver of STEPPER; raises ConfigError."""

    def __init__(self, build: Build, chip: Chip, stepper: "StepperDescription") -> None:
        self.chip = chip
        self._stepper = stepper
        self.sense_ohm = build.get(SENSE_RESISTOR)
        self.largest_a = largest_current(self.sense_ohm)
        self.run_a = self._current(build, RUN_CURRENT, build.get(RUN_CURRENT))
        self.hold_a = min(build.find(HOLD_CURRENT) or self.run_a, self.largest_a)
        home_a = build.find(HOME_CURRENT) if chip.has_stallguard else None
        self.home_a = None if home_a is None else self._current(build, HOME_CURRENT, home_a)
        """None: as it runs."""
        self.interpolate = build.get(INTERPOLATE)
        self.stealthchop = build.get(STEALTHCHOP)
        self.coolstep = build.find(COOLSTEP) if chip.has_stallguard else None
        options = field_options(chip)
        self.fields = {name: int(build.get(option)) for name, option in options.items()}
        microsteps = stepper.microsteps
        if microsteps & (microsteps - 1):
            raise ConfigError(
                stepper.place,
                f"microsteps of [{stepper.name}] is {microsteps}, but its driver [{build.name}] has 1, 2, 4,"
                " 8, 16, 32, 64, 128 or 256",
            )

    def _current(self, build: Build, option: FloatOption, amperes: float) -> float:
        if amperes > self.largest_a:
            build.note(
                option,
                f"is {amperes:g} A, but with sense_resistor {self.sense_ohm:g} ohm the driver gives at most"
                f" {self.largest_a:.3f} A, which is used",
            )
        return min(amperes, self.largest_a)

    def tstep(self, speed: float) -> int:
        """Return the register for a speed of the axis, mm/s."""
        return tstep(speed, self._stepper.step_distance, self._stepper.microsteps)

    def registers(self, *, both_edges: bool) -> dict[str, int]:
        """Return what is to be written, by register in the order of writing."""
        chip, values = self.chip, dict.fromkeys(("GCONF", "SLAVECONF", "IHOLD_IRUN"), 0)
        fields = {
            **self.fields,
            **current_fields(self.currents(self.run_a, self.hold_a)),
            "pdn_disable": 1,
            "mstep_reg_select": 1,
            "en_spreadcycle": int(not self.stealthchop),
            "tpwmthrs": self.tstep(self.stealthchop) if self.stealthchop else 0,
            # Data sheet: at least 2 where several drivers are on one wire.
            "senddelay": 2,
            "mres": 8 - (self._stepper.microsteps.bit_length() - 1),
            "intpol": int(self.interpolate),
            "dedge": int(both_edges),
        }
        if chip.has_stallguard:
            fields["tcoolthrs"] = self.tstep(self.coolstep) if self.coolstep else 0
        for name, value in fields.items():
            register = chip.field_register(name)
            assert register is not None, name
            before = values.get(register.name, 0)
            values[register.name] = register.field(name).put(before, value)
        return values

    def currents(self, run_a: float, hold_a: float) -> Currents:
        """Return the registers' figures for currents."""
        return currents(run_a, hold_a, self.sense_ohm)


def current_fields(found: Currents) -> dict[str, int]:
    """Return the fields of a current."""
    return {"vsense": found.vsense, "irun": found.irun, "ihold": found.ihold}

"""The probe as the machine itself sees it: its input and where it is from the nozzle.

``endstop_pin: probe:z_virtual_endstop`` makes the probe the endstop of Z: the pin is that of its section, and
Z is at ``z_offset`` when it triggers. All other options of the section belong to its module (modules/probes).
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final, TypeVar

from coordinator.config.errors import ConfigError, NotSupported
from coordinator.config.file import ConfigFile, RawSection
from coordinator.config.model import PROBE_ENDSTOP, HomingDescription, ProbeDescription
from coordinator.config.options import BadValue, FloatOption, Option, TextOption
from coordinator.config.pins import PRIMARY_NODE, PinName, PinOption, PinRegistry, ProbeSwitch
from coordinator.config.sections.bounds import MAX_POSITION
from coordinator.config.sections.kinematics.frame import Frame
from coordinator.config.sections.reading import Reading

NAME: Final = "probe"
"""Of the probe's own endstop, where it is not that of Z."""
PIN: Final = PinOption(
    name="pin", help="input of the probe; high when triggered, with ! low", pullable=True, share="endstop"
)
SENSOR_PIN: Final = replace(PIN, name="sensor_pin")
INPUTS: Final[Mapping[str, PinOption]] = {"probe": PIN, "bltouch": SENSOR_PIN, "smart_effector": PIN}
"""The input of each kind of probe, by its section."""
OFFSETS: Final = tuple(
    FloatOption(
        name=f"{axis}_offset",
        help=f"how far the probe is from the nozzle along {axis.upper()}",
        default=0.0,
        unit="mm",
        minimum=-MAX_POSITION,
        maximum=MAX_POSITION,
    )
    for axis in "xy"
)
Z_OFFSET: Final = FloatOption(
    name="z_offset",
    help="how high the nozzle is above the bed when the probe triggers; PROBE_CALIBRATE finds it",
    unit="mm",
    minimum=-MAX_POSITION,
    maximum=MAX_POSITION,
)
EDDY: Final = "probe_eddy_current"
"""First word of the sections of probes that are a coil on an I2C bus."""
I2C_MCU: Final = TextOption(name="i2c_mcu", help="node of the I2C bus", default=PRIMARY_NODE)
DESCEND_Z: Final = FloatOption(
    name="descend_z",
    help="height of the nozzle at which a way down ends; it is measured there",
    default=0.5,
    unit="mm",
    above=0,
    maximum=10,
)
LOAD_CELL: Final = "load_cell_probe"
DOUT: Final = PinOption(name="dout_pin", help="input from the chip's data output")
SENSORS: Final = (EDDY, LOAD_CELL)
"""First words of the sections of probes that are no switch."""
_SENSOR: Final = PinOption(name=I2C_MCU.name, help="", share="endstop")
T = TypeVar("T")


def note_probe(config: ConfigFile, pins: PinRegistry) -> None:
    """Have PINS know the input of the probe, if CONFIG has one; what is wrong there its module reports.

    Raises ConfigError where there are two.
    """
    section = _section(config)
    if section is not None and section.kind in SENSORS:
        _note_sensor(section, pins)
        return
    pin = None if section is None else _value(section, INPUTS[section.name])
    if section is not None and pin is not None:
        x, y, z = (_value(section, option) or 0.0 for option in (*OFFSETS, Z_OFFSET))
        pins.probe = ProbeSwitch(pin, (x, y, z), section.name)


def _note_sensor(section: RawSection, pins: PinRegistry) -> None:
    x, y = (_value(section, option) or 0.0 for option in OFFSETS)
    if section.kind == LOAD_CELL:
        dout = _value(section, DOUT)
        if dout is None:
            return  # a chip on SPI, which is not supported yet
        node, z = dout.node, _value(section, Z_OFFSET) or 0.0
    else:
        node = _value(section, I2C_MCU) or PRIMARY_NODE
        z = _value(section, DESCEND_Z) or _value(section, Z_OFFSET) or DESCEND_Z.default or 0.0
    pin = PinName(node if node in pins.nodes else PRIMARY_NODE, section.name, sensor=section.name)
    pins.probe = ProbeSwitch(pin, (x, y, z), section.name)


def _section(config: ConfigFile) -> RawSection | None:
    found = [
        section for name, section in config.sections.items() if name in INPUTS or section.kind in SENSORS
    ]
    if len(found) > 1:
        raise ConfigError(
            found[1].place,
            f"[{found[1].name}] and [{found[0].name}] are both probes; a machine has one: remove the other",
        )
    return found[0] if found else None


def _value(section: RawSection, option: Option[T]) -> T | None:
    given = section.options.get(option.name)
    try:
        return None if given is None else option.parse(given.value)
    except BadValue:
        return None


def read_probe(reading: Reading, frame: Frame) -> ProbeDescription | None:
    """Return the probe of a machine; None: it has none. Raises ConfigError for a use that it cannot have."""
    for rail in frame.rails:
        if rail.homing.virtual_endstop == PROBE_ENDSTOP and rail.axis != "z":
            raise ConfigError(rail.place, f"{PROBE_ENDSTOP} is an endstop of Z; give {rail.axis} a switch")
    found, section = reading.pins.probe, _section(reading.config)
    rail_z = next((rail for rail in frame.rails if rail.axis == "z"), None)
    if found is None or section is None or not frame.rails:
        return None
    try:
        pin = reading.pins.claim(found.pin, INPUTS.get(section.name, _SENSOR), section)
    except NotSupported:
        return None  # its module is left out for the same reason
    if rail_z is not None and rail_z.homing.virtual_endstop == PROBE_ENDSTOP:
        return ProbeDescription(rail_z, found.offset, section.name)
    motors = rail_z if rail_z is not None else frame.rails[0]
    homing = HomingDescription(pin, virtual_endstop=PROBE_ENDSTOP, position_endstop=found.offset[2])
    rail = replace(motors, axis=NAME, homing=homing, place=section.place, second_endstops=())
    return ProbeDescription(rail, found.offset, section.name)

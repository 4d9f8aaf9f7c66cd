"""[probe] as the machine itself sees it: its input and where it is from the nozzle.

``endstop_pin: probe:z_virtual_endstop`` makes the probe the endstop of Z: the pin is that of [probe], and Z
is at ``z_offset`` when it triggers. All other options of the section belong to its module (modules/probes).
"""

from dataclasses import replace
from typing import Final, TypeVar

from coordinator.config.errors import ConfigError, NotSupported
from coordinator.config.file import ConfigFile, RawSection
from coordinator.config.model import PROBE_ENDSTOP, HomingDescription, ProbeDescription
from coordinator.config.options import BadValue, FloatOption, Option
from coordinator.config.pins import PinOption, PinRegistry, ProbeSwitch
from coordinator.config.sections.bounds import MAX_POSITION
from coordinator.config.sections.kinematics.frame import Frame
from coordinator.config.sections.reading import Reading

SECTION: Final = "probe"
PIN: Final = PinOption(
    name="pin", help="input of the probe; high when triggered, with ! low", pullable=True, share="endstop"
)
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
T = TypeVar("T")


def note_probe(config: ConfigFile, pins: PinRegistry) -> None:
    """Have PINS know the input of [probe], if CONFIG has one; what is wrong there its module reports."""
    section = config.sections.get(SECTION)
    pin = None if section is None else _value(section, PIN)
    if section is not None and pin is not None:
        x, y, z = (_value(section, option) or 0.0 for option in (*OFFSETS, Z_OFFSET))
        pins.probe = ProbeSwitch(pin, (x, y, z))


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
    found, section = reading.pins.probe, reading.config.sections.get(SECTION)
    rail_z = next((rail for rail in frame.rails if rail.axis == "z"), None)
    if found is None or section is None or not frame.rails:
        return None
    try:
        pin = reading.pins.claim(found.pin, PIN, section)
    except NotSupported:
        return None  # its module is left out for the same reason
    if rail_z is not None and rail_z.homing.virtual_endstop == PROBE_ENDSTOP:
        return ProbeDescription(rail_z, found.offset)
    motors = rail_z if rail_z is not None else frame.rails[0]
    homing = HomingDescription(pin, virtual_endstop=PROBE_ENDSTOP, position_endstop=found.offset[2])
    rail = replace(motors, axis=SECTION, homing=homing, place=section.place, second_endstops=())
    return ProbeDescription(rail, found.offset)

"""How a rail is homed: its endstop, and the speeds towards it."""

from coordinator.config.errors import NotSupported
from coordinator.config.model import PROBE_ENDSTOP, HomingDescription
from coordinator.config.options import BoolOption, FloatOption, SectionReader
from coordinator.config.pins import PinDescription, PinName, PinOption, PinRegistry
from coordinator.config.sections.bounds import MAX_POSITION, accel_option, position_option, speed_option
from coordinator.config.sections.virtual_endstops import find_diag_pin

ENDSTOP_PIN = PinOption(name="endstop_pin", help="the endstop's input", pullable=True, share="endstop")
POSITION_ENDSTOP = position_option("position_endstop", "where the axis is when the endstop switches")
HOMING_SPEED = speed_option("homing_speed", "speed towards the endstop", 5.0)
SECOND_HOMING_SPEED = speed_option(
    "second_homing_speed", "speed of the second approach; by default half of homing_speed"
)
RETRACT_DISTANCE = FloatOption(
    name="homing_retract_dist",
    help="way back before the second approach; 0: no second approach",
    default=5.0,
    unit="mm",
    minimum=0,
    maximum=MAX_POSITION,
)
RETRACT_SPEED = speed_option("homing_retract_speed", "speed of the way back; by default homing_speed")
ACCEL = accel_option(
    "homing_accel", "acceleration while it homes, where max_accel allows more; by default max_accel"
)
POSITIVE_DIR = BoolOption(
    name="homing_positive_dir",
    help="whether the endstop is at the upper end; by default the end that is nearer to position_endstop",
)
APPROACH = (HOMING_SPEED, SECOND_HOMING_SPEED, RETRACT_DISTANCE, RETRACT_SPEED, ACCEL, POSITIVE_DIR)
HOMING = (ENDSTOP_PIN, POSITION_ENDSTOP, *APPROACH)
WAITING = tuple(option.name for option in (ENDSTOP_PIN, *APPROACH))
"""Read and checked, but of rails that homing does not know yet, and of an axis' second endstop."""


def read_endstop(reader: SectionReader, pins: PinRegistry) -> tuple[PinDescription | None, str]:
    """Return the endstop's pin, and the name of the virtual endstop that it is of.

    That may be one that a later module offers: then there is no pin.
    """
    pin = reader.find(ENDSTOP_PIN)
    if pin is None:
        return None, ""
    if pin.name.endswith("virtual_endstop") and pin.node not in pins.nodes:
        virtual = f"{pin.node}:{pin.name}"
        if virtual == PROBE_ENDSTOP and pins.probe is not None:
            return _probe_pin(reader, pin, pins), virtual
        diag = find_diag_pin(reader, ENDSTOP_PIN, pin, pins)
        return (None if diag is None else pins.claim(diag, ENDSTOP_PIN, reader.section)), virtual
    try:
        return pins.claim(pin, ENDSTOP_PIN, reader.section), ""
    except NotSupported:
        return None, f"{pin.node}:{pin.name}"


def _probe_pin(reader: SectionReader, pin: PinName, pins: PinRegistry) -> PinDescription | None:
    assert pins.probe is not None
    if pin.invert or pin.pull:
        raise reader.bad(
            ENDSTOP_PIN, f"which takes no marks: put them before the pin of [{pins.probe.section}]"
        )
    try:
        return pins.claim(pins.probe.pin, ENDSTOP_PIN, reader.section)
    except NotSupported:
        return None


def read_homing(reader: SectionReader, low: float, high: float, pins: PinRegistry) -> HomingDescription:
    """Return how a rail that goes from LOW to HIGH is homed; raises ConfigError."""
    endstop_pin, virtual = read_endstop(reader, pins)
    position = reader.find(POSITION_ENDSTOP)
    if endstop_pin is not None and virtual == PROBE_ENDSTOP:
        return _read_probe_homing(reader, endstop_pin, low, high, pins)
    if position is not None and not low <= position <= high:
        raise reader.bad(
            POSITION_ENDSTOP, f"must be within position_min and position_max ({low:g} to {high:g} mm)"
        )
    if position is None and endstop_pin is not None:
        reader.get(POSITION_ENDSTOP)  # required: raises
    return _homing(reader, (endstop_pin, virtual), position, _homing_direction(reader, position, low, high))


def _read_probe_homing(
    reader: SectionReader, pin: PinDescription, low: float, high: float, pins: PinRegistry
) -> HomingDescription:
    """Return how Z is homed by the probe: downwards, and its place follows from the z_offset of the probe."""
    assert pins.probe is not None
    position = pins.probe.offset[2]
    if reader.has(POSITION_ENDSTOP):
        raise reader.bad(
            POSITION_ENDSTOP, f"but the z_offset of [{pins.probe.section}] is where Z is; remove it"
        )
    if reader.find(POSITIVE_DIR):
        raise reader.bad(POSITIVE_DIR, "but a probe is lowered to the bed; remove it")
    if not low <= position <= high:
        raise reader.bad(
            ENDSTOP_PIN,
            f"but the z_offset of [{pins.probe.section}], {position:g} mm, is outside position_min"
            f" and position_max ({low:g} to {high:g} mm); lower position_min",
        )
    return _homing(reader, (pin, PROBE_ENDSTOP), position, positive_dir=False)


def _homing_direction(reader: SectionReader, position: float | None, low: float, high: float) -> bool:
    given = reader.find(POSITIVE_DIR)
    at_end = {True: low, False: high}
    if given is not None:
        if position == at_end[given]:
            raise reader.bad(
                POSITIVE_DIR, f"but position_endstop is {position:g} mm, the other end of the axis"
            )
        return given
    if position is None:
        return False
    # In the middle half a guess could drive the axis into its end.
    quarter = (high - low) / 4
    if low + quarter < position < high - quarter:
        raise reader.bad(
            POSITION_ENDSTOP, "at neither end of the axis; add homing_positive_dir to say where to home to"
        )
    return position >= high - quarter


def read_tower_homing(reader: SectionReader, position: float, pins: PinRegistry) -> HomingDescription:
    """Return how a tower or an arm is homed, whose endstop is at its upper end; raises ConfigError.

    POSITION: Z of the head, in the middle, when the endstop switches.
    """
    endstop = read_endstop(reader, pins)
    if reader.find(POSITIVE_DIR) is False:
        raise reader.bad(POSITIVE_DIR, "but the endstop is at the upper end; remove it")
    return _homing(reader, endstop, position, positive_dir=True)


def _homing(
    reader: SectionReader,
    endstop: tuple[PinDescription | None, str],
    position: float | None,
    positive_dir: bool,
) -> HomingDescription:
    speed = reader.get(HOMING_SPEED)
    reader.show_default(POSITIVE_DIR, positive_dir)
    return HomingDescription(
        endstop_pin=endstop[0],
        virtual_endstop=endstop[1],
        position_endstop=position,
        speed=speed,
        second_speed=reader.get_or(SECOND_HOMING_SPEED, speed / 2),
        retract_distance=reader.get(RETRACT_DISTANCE),
        retract_speed=reader.get_or(RETRACT_SPEED, speed),
        positive_dir=positive_dir,
        accel=reader.find(ACCEL),
    )

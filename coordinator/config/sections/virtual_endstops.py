"""``endstop_pin: tmc2209_stepper_x:virtual_endstop``: sensorless homing by a stepper's driver.

The driver raises its DIAG, so the endstop's pin is ``diag_pin`` of the driver's section, on whatever node.
"""

from typing import Final

from coordinator.config.file import ConfigFile
from coordinator.config.options import BadValue, SectionReader
from coordinator.config.pins import PinName, PinOption, PinRegistry
from coordinator.drivers.tmc_chips import CHIPS
from coordinator.support.quoting import nearest, shown

STALL_KINDS: Final = tuple(name for name, chip in CHIPS.items() if chip.has_stallguard)
"""First words of the sections of drivers that can detect the end of an axis."""
NAME: Final = "virtual_endstop"
_DIAG: Final = PinOption(name="diag_pin", help="", pullable=True)


def note_diag_pins(config: ConfigFile, pins: PinRegistry) -> None:
    """Register the diag_pin of every driver's section of CONFIG in PINS."""
    for section in config.sections.values():
        if section.kind not in STALL_KINDS:
            continue
        given = section.options.get(_DIAG.name)
        try:
            found = None if given is None else _DIAG.parse(given.value)
        except BadValue:
            found = None  # reported for its own section
        pins.diag_pins[f"{section.kind}_{section.instance}"] = found


def find_diag_pin(
    reader: SectionReader, option: PinOption, pin: PinName, pins: PinRegistry
) -> PinName | None:
    """Return the pin of the virtual endstop that OPTION names by PIN; None: no module offers it yet.

    Raises ConfigError for a driver that does not exist or has no diag_pin.
    """
    kind, _, stepper = pin.node.partition("_")
    if kind in CHIPS and kind not in STALL_KINDS:
        raise reader.bad(option, f"but a {kind.upper()} cannot detect the end of an axis; use a switch")
    if kind not in STALL_KINDS:
        return None
    section = f"[{kind} {stepper}]"
    if pin.node not in pins.diag_pins:
        hint = nearest(pin.node, pins.diag_pins, pattern=f"'{{}}:{NAME}'") or f"; add {section}"
        raise reader.bad(option, f"but there is no section {section}{hint}")
    if pin.name != NAME:
        raise reader.bad(option, f"but what {section} has is called {NAME}")
    if pin.invert or pin.pull:
        raise reader.bad(option, f"which takes no marks: put them before the diag_pin of {section}")
    found = pins.diag_pins[pin.node]
    if found is None:
        raise reader.bad(option, f"but {section} has no diag_pin; add it, or correct {shown(pin.node)}")
    return found

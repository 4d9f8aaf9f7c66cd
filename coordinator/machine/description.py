"""From a configuration file to the description of a machine, in one call."""

from coordinator.machine.config_file import ConfigFile, RawSection, parse_config
from coordinator.machine.model import (
    CanConnection,
    ExtruderDescription,
    HomingDescription,
    MachineDescription,
    NodeDescription,
    NodePolicy,
    NotYetActing,
    RailDescription,
    StepperDescription,
    UartConnection,
)
from coordinator.machine.pins import PinDescription, PinRegistry
from coordinator.machine.problem import ConfigError, Place, nearest
from coordinator.machine.read_extruder import limits_without_extruder, read_extruder
from coordinator.machine.read_nodes import check_policies, make_pin_registry, read_nodes
from coordinator.machine.read_printer import read_printer
from coordinator.machine.read_steppers import Weights, is_extra_stepper, read_rail
from coordinator.machine.well_known import LATER_SECTIONS

__all__ = [
    "CanConnection",
    "ConfigError",
    "ExtruderDescription",
    "HomingDescription",
    "MachineDescription",
    "NodeDescription",
    "NodePolicy",
    "NotYetActing",
    "PinDescription",
    "Place",
    "RailDescription",
    "StepperDescription",
    "UartConnection",
    "load_machine",
]

_SINGLE_SECTIONS = ("printer", "stepper_x", "stepper_y", "stepper_z", "extruder")
_NAMED_SECTIONS = ("mcu", "board_pins", "duplicate_pin_override")
_WEIGHTS: dict[str, tuple[Weights, Weights, Weights]] = {
    "cartesian": ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0)),
    "corexy": ((1, 1, 0, 0), (1, -1, 0, 0), (0, 0, 1, 0)),
}


def load_machine(path: str) -> MachineDescription:
    """Read and check a configuration file with all it includes.

    Raises ConfigError, one sentence that begins with file and line, for the first mistake found.
    """
    config = parse_config(str(path))
    later: list[NotYetActing] = []
    _check_section_names(config)
    nodes = read_nodes(config, later)
    pins = make_pin_registry(config, nodes)
    printer = read_printer(_required(config, "printer"), later)
    weights = _WEIGHTS[printer.kinematics]
    rails = (
        read_rail(config, "x", weights[0], pins, later),
        read_rail(config, "y", weights[1], pins, later),
        read_rail(config, "z", weights[2], pins, later),
    )
    extruder = None
    limits = limits_without_extruder(printer, rails)
    if "extruder" in config.sections:
        extruder, limits = read_extruder(config.sections["extruder"], printer, rails, pins, later)
    description = MachineDescription(
        path=config.path,
        nodes=nodes,
        kinematics=printer.kinematics,
        limits=limits,
        rails=rails,
        extruder=extruder,
        not_yet_acting=(*later, *_later_sections(config, pins, later)),
        notes=tuple(config.notes),
    )
    check_policies(description.nodes, description.steppers)
    return description


def _required(config: ConfigFile, name: str) -> RawSection:
    section = config.sections.get(name)
    if section is None:
        raise ConfigError(Place(config.path, 0), f"there is no section [{name}]; add it")
    return section


def _is_acting(section: RawSection) -> bool:
    return (
        section.name in _SINGLE_SECTIONS or section.kind in _NAMED_SECTIONS or is_extra_stepper(section.name)
    )


def _check_section_names(config: ConfigFile) -> None:
    for section in config.sections.values():
        if _is_acting(section) or section.kind in LATER_SECTIONS:
            continue
        if section.kind in _SINGLE_SECTIONS:
            raise ConfigError(
                section.place, f"[{section.name}] must be [{section.kind}]: there is only one of it"
            )
        valid = (*_SINGLE_SECTIONS, *_NAMED_SECTIONS, *sorted(LATER_SECTIONS))
        hint = nearest(section.kind, valid, pattern="[{}]") or "; remove it or correct its name"
        raise ConfigError(section.place, f"there is no section [{section.name}]{hint}")


def _later_sections(config: ConfigFile, pins: PinRegistry, later: list[NotYetActing]) -> list[NotYetActing]:
    """Return the sections without a module; raises ConfigError when one takes a stepper's pin."""
    waiting = {(entry.section, name) for entry in later for name in entry.options}
    result = []
    for section in config.sections.values():
        if not _is_acting(section):
            result.append(NotYetActing(section.name, section.place, ()))
            pins.check_unclaimed(section.options.values(), section.name)
        else:
            options = [option for name, option in section.options.items() if (section.name, name) in waiting]
            pins.check_unclaimed(options, section.name)
    return result

"""From a configuration file to the description of a machine, in one call."""

import re
from dataclasses import replace

from coordinator.config.errors import ConfigError, MissingSection, Place
from coordinator.config.file import ConfigFile, RawSection, parse_config, saved_values
from coordinator.config.model import (
    MachineDescription,
    ModuleSection,
    ModuleSections,
    StepperDescription,
    Unsupported,
)
from coordinator.config.saved import ConfigSource
from coordinator.config.sections.extruder import (
    limits_without_extruder,
    read_extruder_steppers,
    read_extruders,
)
from coordinator.config.sections.kinematics.frame import Frame
from coordinator.config.sections.kinematics.registry import KINDS, read_frame
from coordinator.config.sections.nodes import check_policies, make_pin_registry, read_nodes
from coordinator.config.sections.printer import open_printer, read_printer
from coordinator.config.sections.probe import read_probe
from coordinator.config.sections.reading import Reading
from coordinator.config.sections.second_endstops import with_second_endstops
from coordinator.config.sections.shaper import read_shapers
from coordinator.config.sections.steppers import is_extra_stepper
from coordinator.config.sections.tables import read_axis_tables
from coordinator.config.unsupported import UNSUPPORTED_SECTIONS
from coordinator.modules.module_set import build_modules
from coordinator.modules.registry import known_kinds, module_for, option_readers, own_kinds
from coordinator.motion.specs import MotionLimits
from coordinator.support.quoting import nearest

_SINGLE_SECTIONS = (
    *("printer", "stepper_x", "stepper_y", "stepper_z", "extruder", "input_shaper"),
    "axis_tables",
)
SHELL_COMMAND = "gcode_shell_command"
"""Programs of the host, called from macros on other hosts: said once, however many there are."""
_NAMED_SECTIONS = ("mcu", "board_pins", "duplicate_pin_override")
_STEPPERS = "|".join(name for kind in KINDS.values() for name in kind.steppers)
_MOTION_SECTIONS = re.compile(
    rf"stepper_([a-z]|{_STEPPERS})|extruder[1-9]?|extruder1[0-5]|dual_carriage"
    r"|(stepper|carriage|extra_carriage|dual_carriage|extruder_stepper) \S+",
    re.ASCII,
)
"""Sections that have a place in some machine, besides further steppers."""


def load_machine(path: str) -> MachineDescription:
    """Read and check a configuration file with all it includes.

    Raises ConfigError, one sentence that begins with file and line, for the first mistake found.
    """
    return describe(parse_config(str(path)))


def load_changed(path: str, data: bytes) -> MachineDescription:
    """Do what ``load_machine`` does as if the file PATH held DATA; raises ConfigError."""
    return describe(parse_config(path, data=data))


def describe(config: ConfigFile) -> MachineDescription:
    """Return the machine that CONFIG speaks of; raises ConfigError for the first mistake found.

    Where the file collects mistakes it is raised only for those that leave nothing to go on with.
    """
    unsupported: list[Unsupported] = []
    _check_section_names(config)
    nodes = read_nodes(config, unsupported)
    reading = Reading(config, make_pin_registry(config, nodes), unsupported)
    kinematics, reader = open_printer(_required(config, "printer"))
    printer = read_printer(reader)
    frame = with_second_endstops(reading, read_frame(reading, kinematics, reader))
    reading.finish(reader)
    space = frame.kinematics.work_space
    extruders = tuple(
        replace(extruder, limits=_named(extruder.limits, frame))
        for extruder in read_extruders(reading, printer, space)
    )
    followers = read_extruder_steppers(reading, extruders)
    shapers = read_shapers(reading)
    axis_tables = read_axis_tables(reading)
    probe = read_probe(reading, frame)
    description = MachineDescription(
        path=config.path,
        nodes=nodes,
        kinematics=frame.kinematics,
        limits=extruders[0].limits if extruders else _named(limits_without_extruder(printer, space), frame),
        rails=frame.rails,
        motors=frame.steppers,
        home=frame.home,
        dual_carriage=frame.dual_carriage,
        extruders=extruders,
        extruder_steppers=followers,
        shapers=shapers,
        modules=_module_sections(reading),
        unsupported=(),
        notes=(),
        axis_tables=axis_tables,
        probe=probe,
        source=ConfigSource(config.path, config.data, saved_values(config), load_changed),
    )
    unsupported += [
        Unsupported(_section_of(stepper), stepper.place, ("enable_pin",), stepper.unpowered)
        for stepper in description.steppers
        if stepper.unpowered
    ]
    _check_names(description)
    check_policies(description.nodes, description.steppers)
    built = build_modules(description)  # once here, to find mistakes
    reading.pins = built.pins
    return replace(
        description,
        unsupported=(
            *unsupported,
            *(Unsupported(one.name, one.place, (), one.reason) for one in built.left_out.values()),
            *_unsupported_sections(reading, kinematics),
        ),
        notes=(*config.notes, *built.notes),
    )


def _module_sections(reading: Reading) -> ModuleSections:
    """Return what the modules are built from; raises ConfigError."""
    sections: list[ModuleSection] = []
    for section in reading.config.sections.values():
        if any(option_readers(section.name)):
            sections.append(ModuleSection(section, whole=False))
        if not _is_acting(section) and (kind := module_for(section.kind, section.place)) is not None:
            if kind.NAMED and not (kind.NAMELESS or section.instance):
                error = f"[{section.kind}] needs a name; write [{section.kind} NAME]"
                section.report(ConfigError(section.place, error))
            sections.append(ModuleSection(section, whole=True))
            reading.used.add(section.name)
    config = {
        section.name: {option.name: option.value for option in section.options.values()}
        for section in reading.config.sections.values()
    }
    used = {section.name: section.used for section in reading.config.sections.values()}
    return ModuleSections(tuple(sections), reading.pins, config, used)


def _named(limits: MotionLimits, frame: Frame) -> MotionLimits:
    """Return LIMITS that know which options the ranges come from."""
    return replace(limits, range_options=frame.range_options)


def _section_of(stepper: StepperDescription) -> str:
    """Return the section that STEPPER is of, by what its pins are for."""
    return stepper.step_pin.purpose.partition("[")[2].rstrip("]")


def _check_names(description: MachineDescription) -> None:
    """Refuse two steppers of one name, which commands could not tell apart; raises ConfigError."""
    seen: dict[str, Place] = {}
    for stepper in description.steppers:
        other = seen.setdefault(stepper.name, stepper.place)
        if other is not stepper.place:
            raise ConfigError(
                stepper.place, f"a stepper is named {stepper.name} here and at {other}; rename one of them"
            )


def _required(config: ConfigFile, name: str) -> RawSection:
    section = config.sections.get(name)
    if section is None:
        raise MissingSection(config.path, name)
    return section


def _is_acting(section: RawSection) -> bool:
    return (
        section.name in _SINGLE_SECTIONS
        or section.kind in _NAMED_SECTIONS
        or _MOTION_SECTIONS.fullmatch(section.name) is not None
        or is_extra_stepper(section.name)
    )


def _check_section_names(config: ConfigFile) -> None:
    for section in config.sections.values():
        if _is_acting(section) or section.kind in UNSUPPORTED_SECTIONS or section.kind in own_kinds():
            continue
        if section.kind in known_kinds():  # asked for last: it looks through all packages
            continue
        if section.kind in _SINGLE_SECTIONS:
            error = f"[{section.name}] must be [{section.kind}]: there is only one of it"
            section.report(ConfigError(section.place, error))
            continue
        valid = (*_SINGLE_SECTIONS, *_NAMED_SECTIONS, *known_kinds(), *sorted(UNSUPPORTED_SECTIONS))
        hint = nearest(section.kind, valid, pattern="[{}]") or "; remove it or correct its name"
        section.report(ConfigError(section.place, f"there is no section [{section.name}]{hint}"))


def _unsupported_sections(reading: Reading, kinematics: str) -> list[Unsupported]:
    """Return the sections without a module; raises ConfigError when one takes a stepper's pin.

    So it does for a motion section that has no place in this machine.
    """
    waiting = {(entry.section, name) for entry in reading.unsupported for name in entry.options}
    result = []
    for section in reading.config.sections.values():
        if section.name in reading.used and not _is_acting(section):
            continue
        if not _is_acting(section):
            if section.kind != SHELL_COMMAND:
                result.append(Unsupported(section.name, section.place, ()))
            elif not any(entry.section == SHELL_COMMAND for entry in result):
                result.append(Unsupported(SHELL_COMMAND, section.place, (), "no section of that kind is run"))
            reading.pins.check_unclaimed(section.options.values(), section.name)
            continue
        if section.name not in reading.used and section.kind not in ("printer", *_NAMED_SECTIONS):
            useless = (
                f"[{section.name}] has no place in a machine of kinematics {kinematics}; remove it, or"
                " correct its name or 'kinematics' of [printer]"
            )
            section.report(ConfigError(section.place, useless))
        options = [option for name, option in section.options.items() if (section.name, name) in waiting]
        reading.pins.check_unclaimed(options, section.name)
    return result

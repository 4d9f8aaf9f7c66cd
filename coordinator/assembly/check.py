"""Finds everything that is wrong with a configuration, not only the first mistake.

Single options are read on with a value that stands in. A mistake that ends the reading of a section is taken
out, and all is read again; so nothing is reported twice, and nothing that only follows from another mistake.
"""

from typing import Final

from coordinator.assembly.load import describe
from coordinator.config.errors import ConfigError, MissingSection
from coordinator.config.file import ConfigFile, RawSection, parse_config
from nodes.support.errors import CanductorError

PROBLEMS_MAX: Final = 100
"""A file that is no configuration has more; nobody wants to see them."""


def check_config(path: str) -> list[CanductorError]:
    """Return all mistakes in the configuration file PATH and what it includes, by file and line."""
    collected: list[ConfigError] = []
    raised: list[CanductorError] = []
    stood_in: set[str] = set()
    try:
        config = parse_config(path, collected)
        while len(raised) < PROBLEMS_MAX:
            try:
                describe(config)
                break
            except MissingSection as error:
                raised.append(error)
                if error.name in stood_in or not _stand_in(config, error):
                    break
                stood_in.add(error.name)
            except ConfigError as error:
                section = _section_of(config, error)
                # What is raised after a value stood in may well come from that value.
                if section is None or not section.stands_in:
                    raised.append(error)
                if section is None or not _take_out(config, section, error):
                    break
    except CanductorError as error:
        raised.append(error)
    every = {str(error): error for error in (*collected, *raised)}
    return sorted(every.values(), key=_order)[:PROBLEMS_MAX]


def _order(error: CanductorError) -> tuple[str, int]:
    return (error.place.path, error.place.line) if isinstance(error, ConfigError) else ("", 0)


def _section_of(config: ConfigFile, error: ConfigError) -> RawSection | None:
    for section in config.sections.values():
        if error.place == section.place or any(o.is_at(error.place) for o in section.options.values()):
            return section
    return None


def _stand_in(config: ConfigFile, error: MissingSection) -> bool:
    """Put a section in the place of the one that ERROR is about; return whether that makes sense.

    Without [printer] nobody knows what the others are to be, but for a machine with the steppers of axes.
    """
    if error.name == "printer" and not config.sections.keys() >= {"stepper_x", "stepper_y"}:
        return False
    config.sections[error.name] = RawSection(
        error.name, error.place, problems=config.problems, is_set_aside=True, stands_in=True
    )
    return True


def _take_out(config: ConfigFile, section: RawSection, error: ConfigError) -> bool:
    """Take out of SECTION what ERROR is about; return whether anything is left to be read."""
    for name, option in section.options.items():
        if option.is_at(error.place):
            del section.options[name]
            section.set_aside.add(name)
            return True
    if section.is_set_aside:
        del config.sections[section.name]
        return section.kind not in ("mcu", "printer")
    section.options.clear()
    section.is_set_aside = section.stands_in = True
    return True

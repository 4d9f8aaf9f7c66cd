"""What every reader of a machine's sections shares: the file, the pins, and what was read so far."""

from dataclasses import dataclass, field

from coordinator.config.errors import MissingSection, Place
from coordinator.config.file import ConfigFile, RawSection
from coordinator.config.model import Unsupported
from coordinator.config.options import SectionReader
from coordinator.config.pins import PinDescription, PinRegistry


@dataclass(frozen=True, slots=True)
class SecondEndstop:
    """The endstop of a further stepper of a rail."""

    section: str
    place: Place
    pin: PinDescription
    virtual: str
    """The virtual endstop that it is of; empty: it is a switch."""


@dataclass(slots=True)
class Reading:
    """One reading of a configuration."""

    config: ConfigFile
    pins: PinRegistry
    unsupported: list[Unsupported] = field(default_factory=list)
    used: set[str] = field(default_factory=set)
    """Names of sections that have a place in this machine."""
    second_endstops: dict[str, SecondEndstop] = field(default_factory=dict)
    """Of further steppers of rails, by the stepper."""

    def find(self, name: str) -> RawSection | None:
        """Return a section, which then counts as used, or None."""
        self.used.add(name)
        return self.config.sections.get(name)

    def get(self, name: str, why: str) -> RawSection:
        """Return a section; raises ConfigError with the reason WHY it is needed."""
        section = self.find(name)
        if section is None:
            raise MissingSection(self.config.path, name, why)
        return section

    def named(self, kind: str) -> list[RawSection]:
        """Return all sections [KIND NAME] in the order of the file."""
        found = [s for s in self.config.sections.values() if s.kind == kind and s.instance]
        self.used.update(section.name for section in found)
        return found

    def finish(self, reader: SectionReader, *, waiting: tuple[str, ...] = ()) -> None:
        """Finish a section and note which options wait for a module; raises ConfigError for useless ones.

        WAITING: names of options that were read and checked but are not supported yet.
        """
        unread = {option.name for option in reader.finish()}
        names = tuple(name for name in reader.section.options if name in unread or name in waiting)
        if names:
            self.unsupported.append(Unsupported(reader.name, reader.place, names))

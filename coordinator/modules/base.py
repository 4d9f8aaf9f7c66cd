"""The interface between the machine and its modules.

A section ``[heater_fan hotend]`` of the configuration becomes one object of a subclass of ``Module``:

1. It is built from its section, when the configuration is read, also where nothing is connected: it reads all
   of its options, claims its pins, adds its devices and its commands. A user's mistake is a ConfigError.
2. ``link``: all modules are built; it finds the others it depends upon.
3. ``connect``: its nodes are configured and their clocks known; it may talk to them, and may fail.
4. ``ready``: everything is connected. It must not fail.
5. ``stopped``: a node or the host stopped the machine for safety; nodes have put their outputs to defaults.
6. ``close``: the machine is closed, whether it was ever connected or not.
   A module that stops acting in both cases overrides ``end``, which both of them call.

A restart makes new modules: all state is in the object. Everything happens on the control loop, except that
``GCodeCommand.read`` runs where the program is read (coordinator/gcode/commands.py).
"""

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar

from coordinator.config.errors import ConfigError, NotSupported, Place
from coordinator.config.file import RawSection
from coordinator.config.model import MachineDescription
from coordinator.config.options import BadValue, ListOption, Option, SectionReader, SectionSpec
from coordinator.config.pins import PinDescription, PinOption, PinRegistry
from coordinator.gcode.commands import Call, GCodeCommand, Reading
from coordinator.gcode.parser import WordError, command_line
from coordinator.motion.planner.planner import Planner
from coordinator.motion.steps.surface import Surface
from coordinator.runtime.machine import Modules
from coordinator.runtime.module_context import ModuleContext
from coordinator.support.quoting import shown
from coordinator.support.values import Value
from nodes.node.config import NodeConfig
from nodes.node.node import Node
from nodes.support.errors import CanductorError

__all__ = ["Build", "Device", "Module", "Modules"]


class Device(Protocol):
    """The host's side of an object on a node."""

    def configure(self, config: NodeConfig) -> None:
        """Add it to the configuration of its node; raises NodeConfigError."""

    def started(self, node: "Node") -> None:
        """Act on a node that is ready: at the start, and each time it comes back after it was lost."""


class Module:
    """One section of the configuration."""

    SPEC: ClassVar[SectionSpec] = SectionSpec(help="", options=())
    """All its options; the reference page is made from it. Modules without a section have none."""
    NAMED: ClassVar[bool] = False
    """Whether there may be several, ``[kind NAME]``; else there is one, ``[kind]``."""
    NAMELESS: ClassVar[bool] = False
    """Whether, where there may be several, one may be without a name."""
    SHOWN_AS: ClassVar[str] = ""
    """Under which name macros and front ends see its status; empty: under that of its section."""
    TITLE: ClassVar[str] = ""
    """How these sections are shown: ``[extruder], [extruder1] …``."""

    def __init__(self, build: "Build") -> None:
        """Read all options; no I/O. Raises ConfigError."""
        self.name = build.name
        """The section's name: ``heater_fan hotend``."""
        self._live: ModuleContext | None = None
        """The running machine; None before ``connect``."""

    def link(self, modules: Modules) -> None:
        """Find other modules; raises ConfigError."""

    async def connect(self, live: ModuleContext) -> None:
        """Start acting; raises CanductorError when the hardware does not allow it."""
        self._live = live

    @property
    def live(self) -> ModuleContext:
        """The running machine; raises CanductorError before ``connect``."""
        if self._live is None:
            raise CanductorError(f"[{self.name}] needs a machine that is connected")
        return self._live

    def ready(self) -> None:
        """Update its state: the machine is ready."""

    def job_begins(self) -> None:
        """Forget what was known of the last job: a service is about to print a file."""

    def stopped(self, cause: str) -> None:
        """Update its state: the machine was stopped because of CAUSE."""
        self.end(cause)

    def close(self) -> None:
        """Release what it holds."""
        self.end("the machine was closed")

    def end(self, cause: str) -> None:
        """Stop acting because of CAUSE; may be called more than once."""

    @property
    def controls(self) -> bool:
        """Whether it acts now on what sensors measure, so that no measurement may be late."""
        return False

    def status(self) -> Mapping[str, Value]:
        """Return its status, for macros and front ends: quickly, and never changed afterwards."""
        return {}

    def stands_for(self) -> Mapping[str, set[str]]:
        """Return the words of the g-code that its commands stand for, by command."""
        return {}


M = TypeVar("M", bound=Module)
T = TypeVar("T")


class Build:
    """What a module is built from: its SECTION, read by SPEC; or a part of a section that others read too."""

    def __init__(
        self,
        section: RawSection,
        spec: SectionSpec,
        pins: PinRegistry,
        machine: "MachineDescription",
        *,
        whole: bool = True,
        share: "Callable[[type[Module]], Module]",
        unsupported: Collection[str] = (),
    ) -> None:
        self.name = section.name
        self.machine = machine
        """Nodes, steppers, rails, limits: what does not come from modules."""
        self.reader = SectionReader(section, spec, whole=whole)
        self.devices: list[tuple[str, Device, PinDescription | None]] = []
        """With the node of each, and the pin that has to be checked there."""
        self.commands: list[GCodeCommand] = []
        self.replacements: list[tuple[GCodeCommand, str]] = []
        """Commands that may replace another one, and the new name of that one; empty: there is none."""
        self.set_ups: list[Callable[[Planner], None]] = []
        self.z_shift: Callable[[float], float] | None = None
        """As of ``Vocabulary``."""
        self.surface: Surface | None = None
        """The shape of the bed that Z follows from the start."""
        self.notes: list[str] = []
        self.unsupported = unsupported
        """Sections that nothing acts on yet."""
        self._pins = pins
        self._share = share

    @property
    def instance(self) -> str:
        """What follows the section's first word: ``hotend``; for a plain section the word itself.

        Raises ConfigError for a name that no command can be given.
        """
        name = self.reader.section.instance or self.name
        try:
            command_line("NAMED", NAME=name)
        except WordError:
            raise ConfigError(
                self.place, f"{shown(name)} cannot be named in a command; leave out ; and quotes"
            ) from None
        return name

    @property
    def place(self) -> Place:
        """Where the section stands."""
        return self.reader.place

    def get(self, option: Option[T]) -> T:
        """Return an option's value or its default; raises ConfigError."""
        return self.reader.get(option)

    def find(self, option: Option[T]) -> T | None:
        """Return an option's value, or None when it is absent; raises ConfigError."""
        return self.reader.find(option)

    def get_or(self, option: Option[T], default: T) -> T:
        """Return an option's value, or the DEFAULT that the section computes; raises ConfigError."""
        return self.reader.get_or(option, default)

    def path(self, option: Option[str]) -> Path:
        """Return the path in an option, from the configuration's folder, ``~`` a home; raises ConfigError."""
        text = self.get(option)
        try:
            return Path(self.place.path).parent / Path(text).expanduser()
        except RuntimeError:
            raise self.reader.bad(option, "but there is no such home folder; write the whole path") from None

    def pin(self, option: PinOption) -> PinDescription:
        """Take the pin that a required option names; raises ConfigError."""
        return self._pins.claim(self.reader.get(option), option, self.reader.section)

    def find_pin(self, option: PinOption) -> PinDescription | None:
        """Take the pin that an option names, if it is given; raises ConfigError."""
        return None if self.reader.find(option) is None else self.pin(option)

    def pins(self, option: ListOption) -> list[PinDescription]:
        """Take the output pins that an option lists; raises ConfigError."""
        each = PinOption(name=option.name, help=option.help)
        found = []
        for word in self.reader.get(option):
            try:
                pin = each.parse(word)
            except BadValue as error:
                why = str(error) or f"of which each must be {each.rule()}"
                raise self.reader.bad(option, why) from None
            found.append(self._pins.claim(pin, each, self.reader.section))
        return found

    def needs_acting(self, section: str) -> None:
        """Raise NotSupported if SECTION stands in the configuration and nothing acts on its kind yet."""
        if section in self.unsupported:
            raise NotSupported(self.place, f"it is for [{section}], which is not supported yet")

    def note(self, option: Option[Any], sentence: str) -> None:
        """Report something about an option that is no error; SENTENCE continues after the option's name."""
        self.notes.append(f"{self.reader.place_of(option)}: '{option.name}' of [{self.name}] {sentence}")

    def add_device(self, node: str, device: Device, pin: PinDescription | None = None) -> None:
        """Add DEVICE to a node; if its firmware has no PIN, that is an error of the option that names it."""
        self.devices.append((node, device, pin))

    def add_command(
        self, name: str, text: str, read: Callable[[Call], Reading], *, while_printing: bool = False
    ) -> None:
        """Add the command NAME to those of programs; arguments as in GCodeCommand, TEXT is its help."""
        self.commands.append(GCodeCommand(name, text, read, while_printing=while_printing))

    def replace_command(self, command: GCodeCommand, rename: str = "") -> None:
        """Add COMMAND to those of programs; one that had its name before is renamed to RENAME."""
        self.replacements.append((command, rename))

    def set_up_programs(self, call: "Callable[[Planner], None]") -> None:
        """Call CALL for every program that begins, in the reader's thread."""
        self.set_ups.append(call)

    def shared(self, kind: type[M]) -> M:
        """Return the one module of KIND without a section, which is made when it is first asked for.

        It is where modules of several sections meet: it has their commands in common.
        """
        found = self._share(kind)
        assert isinstance(found, kind)
        return found

    def needed(self, option: Option[str], kind: type[M]) -> Callable[[Modules], M]:
        """Return what finds, in ``link``, the module of KIND that OPTION names; raises ConfigError."""
        name = self.reader.get(option)

        def find(modules: Modules) -> M:
            found = modules.find(name, kind)
            if found is None:
                if modules.is_left_out(name):
                    raise NotSupported(
                        self.reader.place_of(option), f"it needs [{name}], which is not supported yet"
                    )
                raise self.reader.unknown(option, name, modules.names(kind), "[{}]")
            return found

        return find

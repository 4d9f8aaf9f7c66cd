"""All modules of one machine, from its configuration to its end."""

import contextlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Final, TypeVar

from coordinator.config.errors import ConfigError, NotSupported, Place
from coordinator.config.file import RawSection
from coordinator.config.model import MachineDescription, ModuleSection
from coordinator.config.pins import PinDescription, PinRegistry
from coordinator.config.unsupported import UNSUPPORTED_SECTIONS
from coordinator.gcode.absent_commands import ABSENT
from coordinator.gcode.builtins.basic import HANDLERS, WHILE_PRINTING
from coordinator.gcode.builtins.command_help import BUILTIN_HELP
from coordinator.gcode.commands import GCodeCommand, Vocabulary, renamed
from coordinator.kinematics.generic_cartesian import GenericCartesian
from coordinator.modules.base import Build, Device, Module
from coordinator.modules.drivers.motor_power import MotorPower
from coordinator.modules.drivers.stepper_buzz import StepperBuzz
from coordinator.modules.heaters.sections import ExtruderHeaterSection
from coordinator.modules.homing.homing import Homing
from coordinator.modules.motion.stepper_carriages import StepperCarriages
from coordinator.modules.probes.manual_probe import ManualProbe
from coordinator.modules.programs.idle_timeout import IdleTimeout
from coordinator.modules.programs.save_config import SaveConfig
from coordinator.modules.registry import module_for, option_readers
from coordinator.modules.status.console import Console
from coordinator.modules.status.positions import Positions
from coordinator.motion.planner.planner import Planner
from coordinator.motion.steps.surface import Surface
from coordinator.runtime.machine import Machine
from coordinator.runtime.module_context import ModuleContext
from coordinator.support.file_writer import FileWriter
from coordinator.support.values import Value
from nodes.node.config import NodeConfig
from nodes.node.node import Node
from nodes.support.errors import CanductorError

M = TypeVar("M", bound=Module)
K = TypeVar("K")
IDLE_TIMEOUT: Final = "idle_timeout"
FREE_NAMES: Final = frozenset(
    ("G2", "G3", "G5", "G17", "G18", "G19", "M118", "M201", "M203", "M205", "BED_MESH_CHECK")
)
"""Commands of ours that other hosts do not have by themselves: macros take their names as they come."""
INTERRUPTING: Final = frozenset(("PAUSE", "CANCEL_PRINT"))
"""Commands that pause or cancel a job, whatever macros they may be."""


@dataclass(frozen=True, slots=True)
class ModuleSource:
    """A section and the module that it is for."""

    section: RawSection
    kind: type[Module]
    whole: bool
    """Whether the whole section is the module's."""


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A section whose module was left out."""

    name: str
    place: Place
    kind: type[Module]
    reason: str
    """What it depends on that does not act."""


def build_modules(machine: MachineDescription, files: FileWriter | None = None) -> "ModuleSet":
    """Build the modules of MACHINE, linked with each other; raises ConfigError.

    FILES writes what they keep; None: one of their own.
    """
    given = machine.modules
    sources = [source for section in given.sections for source in _sources(section)]
    without: dict[str, NotSupported] = {}
    while True:
        built = ModuleSet(machine, given.pins.copy(), given.config, given.settings, files)
        for source in sources:
            built.build_or_leave_out(source, without)
        built.add_always()
        try:
            built.link()
        except _LinkNotSupported as found:
            # What depends on it may have to be left out, too: all are built again.
            without[found.module] = found.error
        else:
            return built


def _sources(given: ModuleSection) -> Iterator[ModuleSource]:
    section = given.section
    if not given.whole:
        yield from (ModuleSource(section, kind, whole=False) for kind in option_readers(section.name))
    elif (own := module_for(section.kind, section.place)) is not None:
        yield ModuleSource(section, own, whole=True)


class _LinkNotSupported(Exception):  # noqa: N818 (no mistake)
    """A module turned out, when it looked for others, not to act yet."""

    def __init__(self, module: str, error: NotSupported) -> None:
        super().__init__(str(error))
        self.module = module
        self.error = error


@contextlib.contextmanager
def _blamed(kind: type[Module], place: Place) -> Iterator[None]:
    """Report which module of another package raised an unexpected exception; bugs of our own are raised."""
    try:
        yield
    except CanductorError:
        raise
    except Exception as error:
        if kind.__module__.partition(".")[0] == "coordinator":
            raise
        sentence = (
            f"the module {kind.__module__}.{kind.__name__} failed: {type(error).__name__}: {error}; update or"
            " remove its package"
        )
        if place.path:
            raise ConfigError(place, sentence) from error
        raise CanductorError(sentence) from error  # it has no section of its own


class ModuleSet:
    """The modules, by the names of their sections."""

    def __init__(
        self,
        machine: MachineDescription,
        pins: PinRegistry,
        config: Mapping[str, Mapping[str, str]] | None = None,
        settings: Mapping[str, Mapping[str, object]] | None = None,
        files: FileWriter | None = None,
    ) -> None:
        self.pins = pins
        self.files = files or FileWriter()
        self.config = config or {}
        self.settings = settings or {}
        self._unsupported = [name for name in self.config if name.partition(" ")[0] in UNSUPPORTED_SECTIONS]
        self._machine = machine
        self._modules: list[Module] = []
        self._named: dict[str, list[Module]] = {}
        self._controlling: list[Module] = []
        """Those that may ever act on what sensors measure."""
        self._places: dict[Module, Place] = {}
        self._devices: dict[str, list[tuple[Device, PinDescription | None]]] = {}
        self._commands: dict[str, GCodeCommand] = {}
        self._owners: dict[str, str] = {}
        self._set_ups: list[Callable[[Planner], None]] = []
        self._surface: Surface | None = None
        self._z_shift: Callable[[float], float] | None = None
        self._replacements: list[tuple[GCodeCommand, str, Build]] = []
        self.notes: list[str] = []
        """Sentences about what is no mistake."""
        self.left_out: dict[str, LeftOut] = {}
        """Sections whose module does not act, as something that it depends on is not supported yet."""
        self._live: ModuleContext | None = None
        self._homing = self.shared(Homing)
        self._motors = self.shared(MotorPower)
        if isinstance(machine.kinematics, GenericCartesian):
            self.shared(StepperCarriages)
        self.shared(ManualProbe)
        self.shared(Positions)
        self.shared(SaveConfig)
        self.shared(Console)
        self.shared(StepperBuzz)

    def build(self, source: ModuleSource) -> Module:
        """Make the module of SOURCE; raises ConfigError."""
        build = Build(
            source.section,
            source.kind.SPEC,
            self.pins,
            self._machine,
            whole=source.whole,
            share=self._share,
            unsupported=self._unsupported,
        )
        with _blamed(source.kind, source.section.place):
            module = source.kind(build)
        build.reader.finish()
        self._add(module, build)
        return module

    def build_or_leave_out(self, source: ModuleSource, without: Mapping[str, NotSupported]) -> None:
        """Make the module of SOURCE, unless it is among those to be left out or turns out to be one.

        Raises ConfigError for a mistake.
        """
        name = source.section.name
        found = without.get(name)
        if found is None:
            try:
                self.build(source)
            except NotSupported as error:
                found = error
        if found is not None:
            self.left_out[name] = LeftOut(name, source.section.place, source.kind, found.reason)

    def add_always(self) -> None:
        """Build the modules that every machine has, with or without their sections."""
        if self.find(IDLE_TIMEOUT, IdleTimeout) is None and IDLE_TIMEOUT not in self.left_out:
            section = RawSection(IDLE_TIMEOUT, Place("", 0))
            self.build(ModuleSource(section, IdleTimeout, whole=True))

    def shared(self, kind: type[M]) -> M:
        """Return the one module of KIND that has no section."""
        found = self._share(kind)
        assert isinstance(found, kind)
        return found

    def _share(self, kind: type[Module]) -> Module:
        for module in self._modules:
            if type(module) is kind:
                return module
        section = RawSection(kind.__name__.lower(), Place("", 0))
        return self.build(ModuleSource(section, kind, whole=True))

    def _add(self, module: Module, build: Build) -> None:
        self._modules.append(module)
        self._named.setdefault(module.name, []).append(module)
        if type(module).controls is not Module.controls:
            self._controlling.append(module)
        self._places[module] = build.place
        for node, device, pin in build.devices:
            self._devices.setdefault(node, []).append((device, pin))
        for command in build.commands:
            owner = self._owners.setdefault(command.name, build.name)
            if owner != build.name and command.name in self._commands:
                raise ConfigError(
                    build.place,
                    f"[{build.name}] adds the command {command.name}, which is {self._whose(owner)}; rename"
                    " one",
                )
            self._commands[command.name] = command
        self._set_ups += build.set_ups
        self._surface = build.surface or self._surface
        self._z_shift = build.z_shift or self._z_shift
        self.notes += build.notes
        self._replacements += [(command, rename, build) for command, rename in build.replacements]

    def link(self) -> None:
        """Link all modules; raises ConfigError."""
        for command, rename, build in self._replacements:
            self._replace(command, rename, build)
        for module in self._modules:
            try:
                with _blamed(type(module), self._places[module]):
                    module.link(self)
            except NotSupported as error:
                raise _LinkNotSupported(module.name, error) from None

    def _replace(self, command: GCodeCommand, rename: str, build: Build) -> None:
        """Add COMMAND; the command that had its name before is renamed to RENAME."""
        name = command.name
        before = self._commands.get(name)
        if not rename and name not in FREE_NAMES and (before is not None or name in BUILTIN_HELP):
            # What has no help does nothing by itself: M106 without a fan is a name that is free.
            section = build.reader.section
            if section.misspelt or "rename_existing" in section.set_aside:
                return  # what is wrong with it is reported already
            whose = self._whose(self._owners.get(name, ""))
            raise ConfigError(
                build.place,
                f"[{build.name}] takes the name of the command {name}, which is {whose}; add rename_existing"
                f" with another name for that one, such as {name}{'.1' if name[1:].isdigit() else '_BASE'}",
            )
        if rename:
            if not self.knows(name) and name not in self.unsupported:
                raise ConfigError(
                    build.place,
                    f"[{build.name}] has rename_existing, but there is no command {name}; remove that option",
                )
            if self.knows(rename):
                raise ConfigError(
                    build.place,
                    f"rename_existing of [{build.name}] is {rename}, which is a command already; choose a"
                    " name that none has",
                )
            self._commands[rename] = renamed(before, name, rename, while_printing=name in WHILE_PRINTING)
            self._owners[rename] = self._owners.get(name, build.name)
        self._commands[name] = command
        self._owners[name] = build.name

    def _whose(self, owner: str) -> str:
        """Return which section a command belongs to, of which OWNER is the module."""
        of_a_section = any(module.name == owner and self._places[module].path for module in self._modules)
        return f"that of [{owner}]" if of_a_section else "canductor's own"

    # ---------------------------------------------------------------------------------------- looking up

    def knows(self, command: str) -> bool:
        """Return whether programs know COMMAND, by a module or anyway."""
        return command in self._commands or command in HANDLERS

    @property
    def unsupported(self) -> Mapping[str, str]:
        """Why nothing acts on commands that sections of the configuration should bring, by their names."""
        kinds = {name.partition(" ")[0]: name for name in reversed(tuple(self.config))}
        found: dict[str, str] = {}
        for name, absent in ABSENT.items():
            section = next((kinds[kind] for kind in absent.sections if kind in kinds), None)
            if section is not None and name not in self._commands:
                found[name] = f"[{section}] is not supported yet"
        for left in reversed(self.left_out.values()):
            kind = left.name.partition(" ")[0].rstrip("0123456789")
            for name, absent in ABSENT.items():
                if kind in absent.sections and name not in self._commands:
                    found[name] = f"[{left.name}] is not supported yet: {left.reason}"
        return found

    @property
    def command_help(self) -> Mapping[str, str]:
        """What each command of programs does, by its name."""
        return {**BUILTIN_HELP, **{name: command.help for name, command in self._commands.items()}}

    def find(self, name: str, kind: type[K]) -> K | None:
        """Return the module of section NAME, or None when there is none of KIND."""
        for module in self._named.get(name, ()):
            if isinstance(module, kind):
                return module
        return None

    def names(self, kind: type[Module]) -> list[str]:
        """Return the section names of all modules of KIND."""
        return [module.name for module in self._modules if isinstance(module, kind)]

    def is_left_out(self, name: str) -> bool:
        """Return whether NAME, a section or a heater of that name, is one that is not supported yet."""
        return name in self.left_out or f"heater_generic {name}" in self.left_out

    def of(self, kind: type[K]) -> Iterator[K]:
        """Yield all modules of KIND."""
        for module in self._modules:
            if isinstance(module, kind):
                yield module

    @property
    def vocabulary(self) -> Vocabulary:
        """What programs know through them."""
        homing = self._homing
        home = homing.read if homing.corrected is None else homing.corrected(homing.read)
        return Vocabulary(
            self._commands,
            home if homing.acts else None,
            self._too_cold,
            self._z_shift,
            self._containing(INTERRUPTING & self._commands.keys()),
            self._containing(self._disturbing()),
            self.unsupported,
            set_ups=tuple(self._set_ups),
            surface=self._surface,
        )

    def _disturbing(self) -> set[str]:
        """Return the commands that move or wait, so that they cannot run while a job prints."""
        own = {name for name in HANDLERS if name not in WHILE_PRINTING and name not in self._commands}
        return own | {name for name, command in self._commands.items() if not command.while_printing}

    def _containing(self, commands: AbstractSet[str]) -> frozenset[str]:
        """Return COMMANDS, and macros in whose lines they come, directly or by way of others."""
        words = {name: inner for module in self._modules for name, inner in module.stands_for().items()}
        found = set(commands)
        while more := {name for name, inner in words.items() if inner & found} - found:
            found |= more
        return frozenset(found)

    def _too_cold(self, extruder: str) -> bool:
        if extruder in self.left_out:
            return self._live is not None  # its temperature is unknown; a plan assumes that it is hot
        found = self.find(extruder, ExtruderHeaterSection)
        return found is not None and found.too_cold

    @property
    def nodes(self) -> Sequence[str]:
        """Names of the nodes that carry anything of them."""
        return tuple(self._devices)

    def configure(self, config: NodeConfig) -> None:
        """Add all that is on a node to its CONFIG; raises CanductorError."""
        known = config.dictionary.enumerations.get("pin")
        for device, pin in self._devices.get(config.name, ()):
            if pin is not None:
                pin.number({} if known is None else known.values)  # raises ConfigError with file and line
            device.configure(config)

    # ---------------------------------------------------------------------------------------------- life

    def node_started(self, node: "Node") -> None:
        """Inform the devices of NODE, which is ready, for the first time or again."""
        for device, _ in self._devices.get(node.name, ()):
            device.started(node)

    async def connect(self, machine: Machine, say: Callable[[str], None]) -> None:
        """Connect all modules with MACHINE, then report it ready to them; SAY shows a sentence to the user.

        Raises CanductorError.
        """
        live = self._live = ModuleContext(machine, say)
        for module in self._modules:
            with _blamed(type(module), self._places[module]):
                await module.connect(live)
        for module in self._modules:
            module.ready()

    def job_begins(self) -> None:
        """Inform all modules that a file is going to be printed."""
        for module in self._modules:
            module.job_begins()

    def before_motion(self, steppers: Collection[str]) -> None:
        """Get ready for steps of STEPPERS, which follow no sooner than a start from standstill takes."""
        self._motors.on(steppers)

    @property
    def controls(self) -> bool:
        """Whether any of them acts now on what sensors measure."""
        return any(module.controls for module in self._controlling)

    def stopped(self, cause: str) -> None:
        """Inform all modules that the machine is stopped."""
        if self._live is not None:
            for module in self._modules:
                module.stopped(cause)

    def close(self) -> None:
        """End all."""
        with contextlib.ExitStack() as stack:
            if self._live is not None:
                stack.callback(self._live.close)
            for module in self._modules:
                stack.callback(module.close)
        self._live = None

    def status(self) -> Mapping[str, Mapping[str, Value]]:
        """Return the status of each module, by the name of its section."""
        return {
            module.SHOWN_AS or module.name: status for module in self._modules if (status := module.status())
        }

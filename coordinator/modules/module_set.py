"""All modules of one machine, from its configuration to its end."""

import contextlib
import copy
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, TypeVar

from coordinator.gcode.commands import GCodeCommand, Vocabulary
from coordinator.machine.config_file import RawSection
from coordinator.machine.pins import PinRegistry
from coordinator.machine.problem import ConfigError, Place
from coordinator.modules.base import Build, Device, Module, Value
from coordinator.modules.homing import Homing
from coordinator.modules.motor_power import MotorPower
from coordinator.modules.save_config import SaveConfig
from nodes.errors import CanductorError
from nodes.node_config import NodeConfig
from nodes.records import record

if TYPE_CHECKING:
    from coordinator.machine.model import MachineDescription
    from coordinator.modules.live import Live
    from nodes.node import Node

M = TypeVar("M", bound=Module)


@record
class ModuleSource:
    """A section and the module that it is for."""

    section: RawSection
    kind: type[Module]
    whole: bool
    """Whether the whole section is the module's."""


@record
class ModuleSources:
    """What the modules of a machine are made from, as often as it is started."""

    sources: tuple[ModuleSource, ...]
    pins: PinRegistry
    """As the machine's own sections left it."""

    def build(self, machine: "MachineDescription") -> "ModuleSet":
        """Make those of MACHINE, linked with each other; raises ConfigError."""
        built = ModuleSet(machine, copy.deepcopy(self.pins))
        for source in self.sources:
            built.build(source)
        built.link()
        return built


@contextlib.contextmanager
def _blamed(kind: type[Module], place: Place) -> Iterator[None]:
    """Tell the user whose module it was that raised what it must not; a bug of our own stays one."""
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
    """The modules, by the names of their sections; also what they are to each other."""

    def __init__(self, machine: "MachineDescription", pins: PinRegistry) -> None:
        self.pins = pins
        self._machine = machine
        self._modules: list[Module] = []
        self._places: dict[Module, Place] = {}
        self._devices: dict[str, list[Device]] = {}
        self._commands: dict[str, GCodeCommand] = {}
        self._owners: dict[str, str] = {}
        self._live: Live | None = None
        self._homing = self.shared(Homing)
        self._motors = self.shared(MotorPower)
        self.shared(SaveConfig)

    def build(self, source: ModuleSource) -> Module:
        """Make the module of SOURCE; raises ConfigError."""
        build = Build(
            source.section, source.kind.SPEC, self.pins, self._machine, whole=source.whole, share=self._share
        )
        with _blamed(source.kind, source.section.place):
            module = source.kind(build)
        build.reader.finish()
        self._add(module, build)
        return module

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
        self._places[module] = build.place
        for node, device in build.devices:
            self._devices.setdefault(node, []).append(device)
        for command in build.commands:
            owner = self._owners.setdefault(command.name, build.name)
            if owner != build.name and command.name in self._commands:
                raise ConfigError(
                    build.place,
                    f"[{build.name}] brings the command {command.name}, which [{owner}] has; rename one",
                )
            self._commands[command.name] = command

    def link(self) -> None:
        """Let them find each other; raises ConfigError."""
        for module in self._modules:
            with _blamed(type(module), self._places[module]):
                module.link(self)

    # ---------------------------------------------------------------------------------------- looking up

    def find(self, name: str, kind: type[M]) -> M | None:
        """Return the module of section NAME, or None when there is none of KIND."""
        return next((m for m in self._modules if m.name == name and isinstance(m, kind)), None)

    def names(self, kind: type[Module]) -> list[str]:
        """Return the section names of all modules of KIND."""
        return [module.name for module in self._modules if isinstance(module, kind)]

    def of(self, kind: type[M]) -> Iterator[M]:
        """Yield all modules of KIND."""
        for module in self._modules:
            if isinstance(module, kind):
                yield module

    @property
    def vocabulary(self) -> Vocabulary:
        """What programs know through them."""
        home = self._homing.read if self._homing.acts else None
        return Vocabulary(self._commands, home, self._too_cold)

    def _too_cold(self, extruder: str) -> bool:
        from coordinator.modules.heater_sections import ExtruderHeater  # noqa: PLC0415 (start-up time)

        found = self.find(extruder, ExtruderHeater)
        return found is not None and found.too_cold

    @property
    def nodes(self) -> Sequence[str]:
        """Names of the nodes that carry anything of them."""
        return tuple(self._devices)

    def configure(self, config: NodeConfig) -> None:
        """Add all that is on a node to its CONFIG; raises CanductorError."""
        for device in self._devices.get(config.name, ()):
            device.configure(config)

    # ---------------------------------------------------------------------------------------------- life

    def node_started(self, node: "Node") -> None:
        """Take note that NODE is ready, for the first time or again."""
        for device in self._devices.get(node.name, ()):
            device.started(node)

    async def connect(self, live: "Live") -> None:
        """Let all begin to act, then tell them that the machine is ready; raises CanductorError."""
        self._live = live
        for module in self._modules:
            with _blamed(type(module), self._places[module]):
                await module.connect(live)
        for module in self._modules:
            module.ready()

    def before_motion(self) -> None:
        """Get ready for steps, which follow no sooner than a start from standstill takes."""
        self._motors.on()

    def stopped(self, cause: str) -> None:
        """Tell all that the machine is stopped."""
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
        """Tell how each is, by the name of its section."""
        return {module.name: status for module in self._modules if (status := module.status())}

"""[heater_bed], [heater_generic NAME] and the heaters of extruders."""

from collections.abc import Mapping
from typing import ClassVar

from coordinator.config.options import SectionSpec
from coordinator.config.sections.heater_options import (
    EXTRUDER_HEATER_OPTIONS,
    HEATER_OPTIONS,
    HEATER_PIN,
    MIN_EXTRUDE_TEMP,
    UNSUPPORTED_HEATER_OPTIONS,
)
from coordinator.gcode.commands import Call, Reading
from coordinator.gcode.parameters import numbers
from coordinator.gcode.parser import WordError
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.heaters.heater import Heater
from coordinator.modules.heaters.heaters import HeaterRegistry
from coordinator.modules.heaters.pid_profile import PidProfiles
from coordinator.modules.sensors.temperature_sensor import GCODE_ID
from coordinator.runtime.module_context import ModuleContext
from coordinator.support.values import Value


class HeaterSection(Module):
    """A section with a heater."""

    def __init__(self, build: Build, key: str, tag: str = "") -> None:
        super().__init__(build)
        self.unit = Heater(build, key)
        self.heaters = build.shared(HeaterRegistry)
        build.shared(PidProfiles)
        self.heaters.add(self.unit, tag)

    def link(self, modules: Modules) -> None:
        """Find what belongs to the heater."""
        self.unit.link(modules)

    async def connect(self, live: "ModuleContext") -> None:
        """Start acting."""
        await self.unit.connect(live)

    def end(self, cause: str) -> None:
        """Stop acting."""
        self.unit.end(cause)

    def status(self) -> Mapping[str, Value]:
        """Report how the heater is."""
        return self.unit.status()


class HeaterBed(HeaterSection):
    """The heater of the bed."""

    SPEC: ClassVar = SectionSpec(
        help="The heated bed", options=HEATER_OPTIONS, unsupported=UNSUPPORTED_HEATER_OPTIONS
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build, "heater_bed", "B")
        build.add_command("M140", "Set the bed's target: S", self._set, while_printing=True)
        build.add_command("M190", "Set the bed's target and wait for it: S or R", self._wait)

    def _set(self, call: Call) -> Reading:
        return self.heaters.set_target(self.unit, _target(call, "S"))

    def _wait(self, call: Call) -> Reading:
        return self.heaters.set_and_wait(self.unit, _target(call, "SR"))


class HeaterGeneric(HeaterSection):
    """A heater of any kind."""

    NAMED: ClassVar = True
    SPEC: ClassVar = SectionSpec(
        help="A heater for anything else; programs call it by NAME",
        options=(*HEATER_OPTIONS, GCODE_ID),
        unsupported=UNSUPPORTED_HEATER_OPTIONS,
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build, build.instance, build.find(GCODE_ID) or "")


class ExtruderHeaterCommands(Module):
    """The heaters of all extruders, and the commands for them."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        build.shared(PidProfiles)
        self.by_extruder: dict[str, ExtruderHeaterSection] = {}
        self._extruders = [extruder.name for extruder in build.machine.extruders]
        self.heaters = build.shared(HeaterRegistry)
        build.add_command("M104", "Set an extruder's target: S, T", self._set, while_printing=True)
        build.add_command("M109", "Set an extruder's target and wait for it: S or R, T", self._wait)

    def _set(self, call: Call) -> Reading:
        return self.heaters.set_target(self._unit(call), _target(call, "ST"))

    def _wait(self, call: Call) -> Reading:
        return self.heaters.set_and_wait(self._unit(call), _target(call, "SRT"))

    def _unit(self, call: Call) -> Heater:
        words = numbers(call.command, "SRT")
        name = call.extruder or "extruder"
        if "T" in words:
            index = round(words["T"])
            name = "extruder" if index == 0 else f"extruder{index}"
            if name not in self._extruders:
                last = len(self._extruders) - 1
                has = f"T0 to T{last}" if last else "only T0"
                raise WordError(f"{call.command.name} refers to unknown extruder T{index}; there is {has}")
        found = self.by_extruder.get(name)
        if found is None or found.unit is None:
            raise WordError(f"{call.command.name}: [{name}] has no heater; give it a heater_pin")
        return found.unit


class ExtruderHeaterSection(Module):
    """The heater of an extruder; an extruder without heater_pin has none."""

    TITLE: ClassVar = "[extruder], [extruder1] …"
    SPEC: ClassVar = SectionSpec(
        help="The heater of an extruder",
        options=EXTRUDER_HEATER_OPTIONS,
        unsupported=UNSUPPORTED_HEATER_OPTIONS,
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.unit: Heater | None = None
        self.min_extrude_c = build.get(MIN_EXTRUDE_TEMP)
        if build.find(HEATER_PIN) is None:
            return
        self.unit = Heater(build, build.name)
        shared = build.shared(ExtruderHeaterCommands)
        shared.by_extruder[build.name] = self
        shared.heaters.add(self.unit, f"T{build.name.removeprefix('extruder') or 0}")

    def link(self, modules: Modules) -> None:
        """Find what belongs to the heater."""
        if self.unit is not None:
            self.unit.link(modules)

    async def connect(self, live: "ModuleContext") -> None:
        """Start acting."""
        if self.unit is not None:
            await self.unit.connect(live)
            await super().connect(live)

    def end(self, cause: str) -> None:
        """Stop acting."""
        if self.unit is not None:
            self.unit.end(cause)

    @property
    def too_cold(self) -> bool:
        """Whether it is connected and too cold; one that is only planned with is not."""
        return self._live is not None and not self.can_extrude

    @property
    def can_extrude(self) -> bool:
        """Whether it is hot enough to move filament; one without heater always is."""
        if self.unit is None:
            return True
        celsius = self.unit.input.sound_c
        return celsius is not None and celsius >= self.min_extrude_c

    def status(self) -> Mapping[str, Value]:
        """Report how the heater is."""
        if self.unit is None:
            return {}
        return {**self.unit.status(), "can_extrude": self.can_extrude}


def _target(call: Call, allowed: str) -> float:
    """Return the target of a command; without one it is 0."""
    words = numbers(call.command, allowed)
    return words.get("S", words.get("R", 0.0))

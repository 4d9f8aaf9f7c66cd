"""Which module a section is for. Third parties add theirs by the entry point group ``canductor.modules``."""

import re
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Final

from coordinator.config.errors import ConfigError, Place
from coordinator.modules.base import Module

ENTRY_POINTS: Final = "canductor.modules"
"""Name: the section's first word; value: ``package.module:Class``."""
_OURS: Final[dict[str, str]] = {
    "adc_temperature": "coordinator.modules.sensors.thermistor:AdcTemperature",
    "controller_fan": "coordinator.modules.fans.automatic_fans:ControllerFan",
    "delayed_gcode": "coordinator.modules.programs.delayed_gcode:DelayedGCode",
    "display_status": "coordinator.modules.status.display_status:DisplayStatus",
    "exclude_object": "coordinator.modules.programs.exclude_object:ExcludeObject",
    "fan": "coordinator.modules.fans.fans:Fan",
    "fan_generic": "coordinator.modules.fans.fans:FanGeneric",
    "filament_switch_sensor": "coordinator.modules.sensors.filament_switch_sensor:FilamentSwitchSensor",
    "firmware_retraction": "coordinator.modules.motion.firmware_retraction:FirmwareRetraction",
    "force_move": "coordinator.modules.motion.force_move:ForceMove",
    "gcode_arcs": "coordinator.modules.motion.gcode_arcs:GCodeArcs",
    "gcode_button": "coordinator.modules.sensors.gcode_button:GCodeButton",
    "gcode_macro": "coordinator.modules.programs.gcode_macro:GCodeMacro",
    "heater_bed": "coordinator.modules.heaters.sections:HeaterBed",
    "heater_fan": "coordinator.modules.fans.automatic_fans:HeaterFan",
    "heater_generic": "coordinator.modules.heaters.sections:HeaterGeneric",
    "homing_override": "coordinator.modules.homing.homing_override:HomingOverride",
    "idle_timeout": "coordinator.modules.programs.idle_timeout:IdleTimeout",
    "output_pin": "coordinator.modules.outputs.output_pin:OutputPin",
    "pause_resume": "coordinator.modules.programs.pause_resume:PauseResume",
    "pid_profile": "coordinator.modules.heaters.pid_profile:PidProfile",
    "respond": "coordinator.modules.status.respond:Respond",
    "safe_z_home": "coordinator.modules.homing.safe_z_home:SafeZHome",
    "save_variables": "coordinator.modules.programs.save_variables:SaveVariables",
    "skew_correction": "coordinator.modules.levelling.skew_correction:SkewCorrection",
    "static_digital_output": "coordinator.modules.outputs.output_pin:StaticDigitalOutput",
    "temperature_fan": "coordinator.modules.fans.temperature_fan:TemperatureFan",
    "temperature_sensor": "coordinator.modules.sensors.temperature_sensor:TemperatureSensor",
    "tmc2208": "coordinator.modules.drivers.tmc_driver:Tmc2208",
    "tmc2209": "coordinator.modules.drivers.tmc_driver:Tmc2209",
    "thermistor": "coordinator.modules.sensors.thermistor:Thermistor",
    "verify_heater": "coordinator.modules.heaters.verify_heater:VerifyHeater",
    "virtual_sdcard": "coordinator.modules.programs.virtual_sdcard:VirtualSdcard",
}
"""By the section's first word: module and class."""
_BESIDE: Final[dict[str, str]] = {
    r"extruder[0-9]*": "coordinator.modules.heaters.sections:ExtruderHeater",
}
"""By a pattern of section names that the machine's own readers read too: whose further options they are."""


def own_kinds() -> tuple[str, ...]:
    """Return the first words of the sections that our modules are for."""
    return tuple(_OURS)


def own_modules() -> "Iterator[tuple[str, type[Module]]]":
    """Yield our modules with how their sections are written: ``[fan]``, ``[fan_generic NAME]``."""
    for kind, path in _OURS.items():
        module = _load(path)
        yield (f"[{kind} NAME]" if module.NAMED else f"[{kind}]"), module


def own_beside() -> "Iterator[tuple[str, type[Module]]]":
    """Yield our modules that read further options of sections that the machine itself reads."""
    for path in _BESIDE.values():
        module = _load(path)
        yield module.TITLE, module


def known_kinds() -> tuple[str, ...]:
    """Return the first words of the sections that some module is for."""
    return (*_OURS, *_others())


def module_for(kind: str, place: Place) -> "type[Module] | None":
    """Return the module for sections ``[KIND ...]``, or None; raises ConfigError when it cannot be loaded."""
    if kind in _OURS:
        return _load(_OURS[kind])
    other = _others().get(kind)
    if other is None:
        return None
    try:
        found = other.load()
    # Whatever code that is not ours raises, its user learns which package it was.
    except Exception as error:
        raise ConfigError(
            place,
            f"the module for [{kind}], {other.value} of package {_package(other)}, cannot be loaded:"
            f" {error or type(error).__name__}; update or remove that package",
        ) from error
    if not (isinstance(found, type) and issubclass(found, Module)):
        raise ConfigError(
            place,
            f"{other.value} of package {_package(other)} is no module for [{kind}]: it must be a subclass of"
            " coordinator.modules.base.Module; update or remove that package",
        )
    return found


def modules_beside(section: str) -> "Iterator[type[Module]]":
    """Yield the modules that read further options of a section that belongs to the machine itself."""
    for pattern, path in _BESIDE.items():
        if re.fullmatch(pattern, section, re.ASCII):
            yield _load(path)


def _load(path: str) -> "type[Module]":
    name, _, attribute = path.partition(":")
    found: type[Module] = getattr(import_module(name), attribute)
    return found


@cache
def _others() -> "dict[str, EntryPoint]":
    return {point.name: point for point in entry_points(group=ENTRY_POINTS)}


def _package(point: "EntryPoint") -> str:
    return point.dist.name if point.dist is not None else "?"

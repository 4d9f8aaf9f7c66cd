"""Which module a section is for. Third parties add theirs by the entry point group ``canductor.modules``."""

import re
from collections.abc import Iterator
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Final

from coordinator.config.errors import ConfigError, Place
from coordinator.modules.base import Module
from coordinator.modules.drivers.tmc_driver import Tmc2208, Tmc2209
from coordinator.modules.fans.automatic_fans import ControllerFan, HeaterFan
from coordinator.modules.fans.fans import Fan, FanGeneric
from coordinator.modules.fans.temperature_fan import TemperatureFan
from coordinator.modules.heaters.pid_profile import PidProfile
from coordinator.modules.heaters.sections import ExtruderHeaterSection, HeaterBed, HeaterGeneric
from coordinator.modules.heaters.verify_heater import VerifyHeater
from coordinator.modules.homing.homing_override import HomingOverride
from coordinator.modules.homing.safe_z_home import SafeZHome
from coordinator.modules.levelling.bed_mesh import BedMeshSection
from coordinator.modules.levelling.skew_correction import SkewCorrection
from coordinator.modules.motion.firmware_retraction import FirmwareRetraction
from coordinator.modules.motion.force_move import ForceMove
from coordinator.modules.motion.gcode_arcs import GCodeArcs
from coordinator.modules.outputs.output_pin import OutputPin, StaticDigitalOutput
from coordinator.modules.probes.switch_probe import SwitchProbe
from coordinator.modules.programs.delayed_gcode import DelayedGCode
from coordinator.modules.programs.exclude_object import ExcludeObject
from coordinator.modules.programs.gcode_macro import GCodeMacro
from coordinator.modules.programs.idle_timeout import IdleTimeout
from coordinator.modules.programs.pause_resume import PauseResume
from coordinator.modules.programs.save_variables import SaveVariables
from coordinator.modules.programs.virtual_sdcard import VirtualSdcard
from coordinator.modules.sensors.filament_switch_sensor import FilamentSwitchSensor
from coordinator.modules.sensors.gcode_button import GCodeButton
from coordinator.modules.sensors.temperature_sensor import TemperatureSensor
from coordinator.modules.sensors.thermistor import AdcTemperature, Thermistor
from coordinator.modules.status.display_status import DisplayStatus
from coordinator.modules.status.respond import Respond

ENTRY_POINTS: Final = "canductor.modules"
"""Name: the section's first word; value: ``package.module:Class``."""
MODULES: Final[dict[str, type[Module]]] = {
    "adc_temperature": AdcTemperature,
    "bed_mesh": BedMeshSection,
    "controller_fan": ControllerFan,
    "delayed_gcode": DelayedGCode,
    "display_status": DisplayStatus,
    "exclude_object": ExcludeObject,
    "fan": Fan,
    "fan_generic": FanGeneric,
    "filament_switch_sensor": FilamentSwitchSensor,
    "firmware_retraction": FirmwareRetraction,
    "force_move": ForceMove,
    "gcode_arcs": GCodeArcs,
    "gcode_button": GCodeButton,
    "gcode_macro": GCodeMacro,
    "heater_bed": HeaterBed,
    "heater_fan": HeaterFan,
    "heater_generic": HeaterGeneric,
    "homing_override": HomingOverride,
    "idle_timeout": IdleTimeout,
    "output_pin": OutputPin,
    "pause_resume": PauseResume,
    "pid_profile": PidProfile,
    "probe": SwitchProbe,
    "respond": Respond,
    "safe_z_home": SafeZHome,
    "save_variables": SaveVariables,
    "skew_correction": SkewCorrection,
    "static_digital_output": StaticDigitalOutput,
    "temperature_fan": TemperatureFan,
    "temperature_sensor": TemperatureSensor,
    "tmc2208": Tmc2208,
    "tmc2209": Tmc2209,
    "thermistor": Thermistor,
    "verify_heater": VerifyHeater,
    "virtual_sdcard": VirtualSdcard,
}
"""Our modules, by the section's first word."""
_OPTION_READERS: Final[dict[str, type[Module]]] = {r"extruder[0-9]*": ExtruderHeaterSection}
"""By a pattern of section names that the machine itself reads: which module reads further options there."""


def own_kinds() -> tuple[str, ...]:
    """Return the first words of the sections that our modules are for."""
    return tuple(MODULES)


def own_modules() -> Iterator[tuple[str, type[Module]]]:
    """Yield our modules with how their sections are written: ``[fan]``, ``[fan_generic NAME]``."""
    for kind, module in MODULES.items():
        yield (f"[{kind} NAME]" if module.NAMED else f"[{kind}]"), module


def own_option_readers() -> Iterator[tuple[str, type[Module]]]:
    """Yield our modules that read further options of sections that the machine itself reads."""
    for module in _OPTION_READERS.values():
        yield module.TITLE, module


def known_kinds() -> tuple[str, ...]:
    """Return the first words of the sections that some module is for."""
    return (*MODULES, *_others())


def module_for(kind: str, place: Place) -> type[Module] | None:
    """Return the module for sections ``[KIND ...]``, or None; raises ConfigError when it cannot be loaded."""
    if kind in MODULES:
        return MODULES[kind]
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


def option_readers(section: str) -> Iterator[type[Module]]:
    """Yield the modules that read further options of a section that belongs to the machine itself."""
    for pattern, module in _OPTION_READERS.items():
        if re.fullmatch(pattern, section, re.ASCII):
            yield module


@cache
def _others() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=ENTRY_POINTS)}


def _package(point: "EntryPoint") -> str:
    return point.dist.name if point.dist is not None else "?"

"""Which module a section is for, by the section's first word.

Modules of this package are listed here, those of other packages by the entry point group
``canductor.modules``. A module is imported when its section is met: a machine has a dozen of them, and all
would take 2 MB of memory.
"""

import re
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Final

from coordinator.config.errors import ConfigError, Place
from coordinator.modules.base import Module

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

ENTRY_POINTS: Final = "canductor.modules"
"""Name: the section's first word; value: ``package.module:Class``."""
SECTIONS: Final = {
    "adc_temperature": "sensors.thermistor:AdcTemperature",
    "axis_twist_compensation": "compensation.axis_twist_compensation:AxisTwistCompensation",
    "bed_mesh": "compensation.bed_mesh:BedMeshSection",
    "bed_screws": "levelling.bed_screws:BedScrews",
    "bed_tilt": "compensation.bed_tilt:BedTilt",
    "bltouch": "probes.bltouch:BLTouch",
    "controller_fan": "fans.automatic_fans:ControllerFan",
    "delayed_gcode": "programs.delayed_gcode:DelayedGCode",
    "delta_calibrate": "levelling.delta_calibrate:DeltaCalibrate",
    "display_status": "status.display_status:DisplayStatus",
    "endstop_phase": "homing.endstop_phase:EndstopPhase",
    "exclude_object": "programs.exclude_object:ExcludeObject",
    "fan": "fans.fans:Fan",
    "fan_generic": "fans.fans:FanGeneric",
    "filament_switch_sensor": "sensors.filament_switch_sensor:FilamentSwitchSensor",
    "firmware_retraction": "motion.firmware_retraction:FirmwareRetraction",
    "force_move": "motion.force_move:ForceMove",
    "gcode_arcs": "motion.gcode_arcs:GCodeArcs",
    "gcode_button": "sensors.gcode_button:GCodeButton",
    "gcode_macro": "programs.gcode_macro:GCodeMacro",
    "heater_bed": "heaters.sections:HeaterBed",
    "heater_fan": "fans.automatic_fans:HeaterFan",
    "heater_generic": "heaters.sections:HeaterGeneric",
    "homing_override": "homing.homing_override:HomingOverride",
    "idle_timeout": "programs.idle_timeout:IdleTimeout",
    "load_cell": "load_cells.load_cell_commands:LoadCellModule",
    "load_cell_probe": "load_cells.load_cell_probe:LoadCellProbe",
    "output_pin": "outputs.output_pin:OutputPin",
    "pause_resume": "programs.pause_resume:PauseResume",
    "pid_profile": "heaters.pid_profile:PidProfile",
    "probe": "probes.switch_probe:SwitchProbe",
    "probe_eddy_current": "eddy_current.eddy_probe:EddyProbe",
    "quad_gantry_level": "levelling.quad_gantry_level:QuadGantryLevel",
    "respond": "status.respond:Respond",
    "safe_z_home": "homing.safe_z_home:SafeZHome",
    "save_variables": "programs.save_variables:SaveVariables",
    "screws_tilt_adjust": "levelling.screws_tilt_adjust:ScrewsTiltAdjust",
    "skew_correction": "compensation.skew_correction:SkewCorrection",
    "smart_effector": "probes.smart_effector:SmartEffector",
    "static_digital_output": "outputs.output_pin:StaticDigitalOutput",
    "temperature_fan": "fans.temperature_fan:TemperatureFan",
    "temperature_probe": "eddy_current.temperature_probe:TemperatureProbe",
    "temperature_sensor": "sensors.temperature_sensor:TemperatureSensor",
    "thermistor": "sensors.thermistor:Thermistor",
    "tmc2208": "drivers.tmc_driver:Tmc2208",
    "tmc2209": "drivers.tmc_driver:Tmc2209",
    "verify_heater": "heaters.verify_heater:VerifyHeater",
    "virtual_sdcard": "programs.virtual_sdcard:VirtualSdcard",
    "z_thermal_adjust": "compensation.z_thermal_adjust:ZThermalAdjust",
    "z_tilt": "levelling.z_tilt:ZTilt",
    "z_tilt_ng": "levelling.z_tilt_ng:ZTiltNg",
}
"""Our modules: in which file of this package, and the class."""
FURTHER_OPTIONS: Final = {r"extruder[0-9]*": "heaters.sections:ExtruderHeaterSection"}
"""By a pattern of section names that the machine itself reads: which module reads further options there."""


def own_kinds() -> tuple[str, ...]:
    """Return the first words of the sections that our modules are for."""
    return tuple(SECTIONS)


def own_modules() -> Iterator[tuple[str, type[Module]]]:
    """Yield our modules with how their sections are written: ``[fan]``, ``[fan_generic NAME]``."""
    for kind, where in SECTIONS.items():
        module = _own(where)
        yield (f"[{kind} NAME]" if module.NAMED else f"[{kind}]"), module


def own_option_readers() -> Iterator[tuple[str, type[Module]]]:
    """Yield our modules that read further options of sections that the machine itself reads."""
    for where in FURTHER_OPTIONS.values():
        module = _own(where)
        yield module.TITLE, module


def known_kinds() -> tuple[str, ...]:
    """Return the first words of the sections that some module is for."""
    return (*SECTIONS, *_others())


def module_for(kind: str, place: Place) -> type[Module] | None:
    """Return the module for sections ``[KIND ...]``, or None; raises ConfigError when it cannot be loaded."""
    if kind in SECTIONS:
        return _own(SECTIONS[kind])
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
    for pattern, where in FURTHER_OPTIONS.items():
        if re.fullmatch(pattern, section, re.ASCII):
            yield _own(where)


def _own(where: str) -> type[Module]:
    file, _, name = where.partition(":")
    found: type[Module] = getattr(import_module(f"coordinator.modules.{file}"), name)
    return found


@cache
def _others() -> "dict[str, EntryPoint]":
    from importlib.metadata import entry_points  # noqa: PLC0415 (1 MB of memory)

    return {point.name: point for point in entry_points(group=ENTRY_POINTS)}


def _package(point: "EntryPoint") -> str:
    return point.dist.name if point.dist is not None else "?"

"""All objects that clients may watch, as the machine is now; what stays the same is made once per start."""

import os
import time
from collections.abc import Mapping
from typing import Any, Final

from coordinator.klippy_api.motion_objects import idle_objects, motion_objects
from coordinator.klippy_api.node_objects import firmware_of, node_objects
from coordinator.klippy_api.subscription import Status
from coordinator.modules.base import Module
from coordinator.modules.heaters.heaters import HeaterRegistry
from coordinator.modules.programs.gcode_macro import GCodeMacro
from coordinator.modules.status.config_view import config_view, config_warnings
from coordinator.modules.status.machine_view import available_kb
from coordinator.modules.status.print_stats import NOTHING
from coordinator.runtime.machine import Machine
from coordinator.service.core.machine_service import MachineService, ServiceState

STATS_S: Final = 1.0
"""Load and traffic of nodes and computer are looked at again after so long."""
READY: Final = "Printer is ready"
_STARTING: Final = "The machine is starting\nPlease wait a few seconds"
_AFTER_STOP: Final = 'Put the cause right, then start again with "FIRMWARE_RESTART".'
_AFTER_ERROR: Final = 'Put the cause right, then start again with "RESTART".'
_NO_CONFIG: Final[Mapping[str, Any]] = {
    "config": {},
    "settings": {},
    "save_config_pending": False,
    "save_config_pending_items": {},
    "warnings": [],
}
_NO_LAYERS: Final[Mapping[str, Any]] = {"total_layer": None, "current_layer": None}


def state_of(service: "MachineService") -> tuple[str, str]:
    """Return ``state`` and ``state_message``: startup, ready, shutdown or error, and a text for people."""
    if service.state is ServiceState.SHUTDOWN:
        return "shutdown", f"{service.cause}\n{_AFTER_STOP}"
    if service.state is ServiceState.ERROR:
        return "error", f"{service.cause}\n{_AFTER_ERROR}"
    if service.state is ServiceState.STARTUP or service.machine is None:
        return "startup", _STARTING
    return "ready", READY


class _Fixed:
    """What stays the same for as long as MACHINE lives."""

    def __init__(self, machine: "Machine") -> None:
        modules = machine.modules
        view = config_view(modules.config, modules.settings, {})
        described = machine.description
        warnings = config_warnings(described.unsupported, (*described.notes, *modules.notes))
        self.machine = machine
        self.config = {"config": view["config"], "settings": view["settings"], "warnings": warnings}
        self.commands = {name: {"help": text} if text else {} for name, text in modules.command_help.items()}
        self.macros = modules.names(GCodeMacro)
        self.heaters = next(modules.of(HeaterRegistry), None)
        self.order = modules.names(Module)
        self.firmware: dict[str, Mapping[str, Any]] = {}

    def firmware_of_nodes(self) -> Mapping[str, Mapping[str, Any]]:
        """Return it for all nodes whose firmware is known by now, empty texts for others."""
        for name, node in self.machine.nodes.items():
            if not self.firmware.get(name, {}).get("mcu_version"):
                self.firmware[name] = firmware_of(node)
        return self.firmware


class StatusBuilder:
    """Looks at SERVICE; on the control loop."""

    def __init__(self, service: "MachineService") -> None:
        self._service = service
        self._fixed: _Fixed | None = None
        self._slow: Status = {}
        self._slow_at_s = float("-inf")

    def build(self) -> Status:
        """Return all objects. Values are never changed afterwards, and are the same where nothing is new."""
        service = self._service
        state, message = state_of(service)
        objects: dict[str, Mapping[str, Any]] = {"webhooks": {"state": state, "state_message": message}}
        machine = service.machine
        if machine is None:
            return objects | {
                "configfile": _NO_CONFIG,
                "print_stats": {**NOTHING, "info": _NO_LAYERS},
                "idle_timeout": {"state": "Idle", "printing_time": 0.0},
            }
        fixed = self._fixed_of(machine)
        status = machine.modules.status()
        objects["configfile"] = {
            **_NO_CONFIG,
            **status.get("configfile", {}),
            **fixed.config,
        }
        objects["gcode"] = {"commands": fixed.commands}
        objects.update((name, {}) for name in fixed.macros)
        objects.update(self._slow_of(machine, fixed))
        objects.update((name, fields) for name, fields in status.items() if name != "configfile")
        motion, described = service.motion, machine.description
        moving = (
            idle_objects(described)
            if motion is None
            else motion_objects(motion, described, stopped=machine.stopped is not None)
        )
        objects.update((name, {**objects.get(name, {}), **fields}) for name, fields in moving.items())
        self._mend(objects, fixed)
        return objects

    def _fixed_of(self, machine: "Machine") -> _Fixed:
        if self._fixed is None or self._fixed.machine is not machine:
            self._fixed = _Fixed(machine)
            self._slow_at_s = float("-inf")
        return self._fixed

    def _slow_of(self, machine: "Machine", fixed: _Fixed) -> Status:
        now_s = self._service.now_s
        if now_s >= self._slow_at_s + STATS_S or now_s < self._slow_at_s:
            self._slow_at_s = now_s
            computer = {
                "sysload": round(os.getloadavg()[0], 3),
                "cputime": round(time.process_time(), 3),
                "memavail": available_kb(),
            }
            self._slow = {**node_objects(machine, fixed.firmware_of_nodes()), "system_stats": computer}
        return self._slow

    def _mend(self, objects: dict[str, Mapping[str, Any]], fixed: _Fixed) -> None:
        """Convert to the names, units and types that clients expect where modules differ."""
        stats = objects.get("print_stats", {**NOTHING, "info": _NO_LAYERS})
        objects["print_stats"] = stats
        card, folder = objects.get("virtual_sdcard"), self._service.folder
        if card is not None and folder is not None and card["file_path"]:
            objects["virtual_sdcard"] = {**card, "file_path": str(folder.path.absolute() / card["file_path"])}
        shown = objects.get("display_status")
        if shown is not None and shown["progress"] is None:
            progress = 0.0 if card is None else card["progress"]
            objects["display_status"] = {**shown, "progress": progress}
        asked = objects.get("query_endstops")
        if asked is not None:
            pressed = {name: int(found) for name, found in asked["last_query"].items()}
            objects["query_endstops"] = {**asked, "last_query": pressed}
        if fixed.heaters is not None:
            objects["heaters"] = _heaters(fixed.heaters)
            for name in objects["heaters"]["available_sensors"]:
                if name in objects and objects[name].get("temperature", 0.0) is None:
                    objects[name] = {**objects[name], "temperature": 0.0}
                if objects.get(name, {}).get("measured_min_temp", 0.0) is None:
                    now_c = objects[name]["temperature"]
                    lowest_highest = {"measured_min_temp": now_c, "measured_max_temp": now_c}
                    objects[name] = {**objects[name], **lowest_highest}
        else:
            objects["heaters"] = {f"available_{kind}": [] for kind in ("heaters", "sensors", "monitors")}


def _heaters(heaters: HeaterRegistry) -> dict[str, Any]:
    """Return the full names of sections, where programs also know short ones."""
    units = heaters.units
    short = {key for key, unit in units.items() if unit.name != key}
    return {
        "available_heaters": [unit.name for unit in units.values()],
        "available_sensors": [name for name in heaters.sensors if name not in short],
        "available_monitors": [],
    }

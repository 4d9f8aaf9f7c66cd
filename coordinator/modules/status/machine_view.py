"""What macros see of the machine in addition to its modules: nodes, the computer, the commands."""

import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from coordinator.gcode.place import Place
from coordinator.modules.base import Modules
from coordinator.modules.status.lazy_status import LazyStatus
from coordinator.runtime.module_context import ModuleContext
from nodes.node.node import Node
from nodes.support.errors import CanductorError

_MEMORY: Final = Path("/proc/meminfo")


def machine_view(modules: Modules, live: "ModuleContext | None") -> Mapping[str, Mapping[str, object]]:
    """Return it by name; on the control loop. Without LIVE nothing is connected: a program is planned."""
    nodes = {} if live is None else live.machine.nodes
    stopped = None if live is None else live.machine.stopped
    runner = None if live is None else live.machine.runner
    return {
        "gcode": LazyStatus(
            commands=lambda: {name: {"help": text} for name, text in modules.command_help.items()}
        ),
        **{name if name == "mcu" else f"mcu {name}": _node(node) for name, node in nodes.items()},
        "system_stats": LazyStatus(
            sysload=lambda: round(os.getloadavg()[0], 3),
            cputime=lambda: round(time.process_time(), 3),
            memavail=available_kb,
        ),
        "motion_report": LazyStatus(
            live_position=lambda: Place(*_motion(live)[0]),
            live_velocity=lambda: round(_motion(live)[1], 3),
            live_extruder_velocity=lambda: round(_motion(live)[2], 4),
        ),
        "webhooks": {
            "state": "ready" if stopped is None else "shutdown",
            "state_message": "Printer is ready" if stopped is None else str(stopped),
        },
        # As if there were the section: macros ask whether the machine is busy.
        "idle_timeout": {
            "state": "Ready" if runner is not None and not runner.busy else "Printing",
            "printing_time": 0.0,
        },
    }


def _motion(live: "ModuleContext | None") -> tuple[Sequence[float], float, float]:
    """Return place and speeds of the head; on the control loop."""
    runner = None if live is None else live.machine.runner
    return (None if runner is None else runner.live_motion()) or ((0.0,) * 4, 0.0, 0.0)


def _node(node: "Node") -> Mapping[str, object]:
    try:
        dictionary, freq_hz = node.dictionary, node.clock_freq_hz
    except CanductorError:  # lost before it was known, or brought back and not known yet
        return {"mcu_version": "", "mcu_build_versions": "", "mcu_constants": {}, "last_stats": {}}
    load = node.load
    stats = (
        {"freq": freq_hz}
        if load is None
        else {
            "freq": freq_hz,
            "mcu_awake": round(load.awake, 4),
            "mcu_task_avg": load.task_s,
        }
    )
    return {
        "last_stats": stats,
        "mcu_version": dictionary.version,
        "mcu_build_versions": dictionary.build_versions,
        "mcu_constants": dictionary.constants,
    }


def available_kb() -> int:
    """Return how much memory programs may still get, kB; 0: not known."""
    try:
        with _MEMORY.open(encoding="ascii") as file:
            found = [line.split()[1] for line in file if line.startswith("MemAvailable:")]
    except OSError:
        return 0
    return int(found[0]) if found else 0

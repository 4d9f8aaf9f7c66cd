"""Methods about the machine as a whole: what it is, its state, stop and restart, configuration, log."""

import asyncio
import platform
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from coordinator.config.file import ConfigFile, parse_config
from coordinator.config.model import MachineDescription
from coordinator.ipc.protocol.methods import Caller, Kind, Method, Param, Scope, shown
from coordinator.service.core.machine_service import MachineService
from coordinator.service.state.log_ring import KEEP
from coordinator.support.values import Value
from coordinator.support.version import VERSION

_CAUSE_MAX: Final = 200
_STATES: Final = (
    Param("state", Kind.STR, "startup, ready, printing, paused, shutdown or error"),
    Param("cause", Kind.STR, "why it is shut down, in error or waits; a sentence, or empty"),
)


def machine_methods(service: MachineService) -> Iterator[Method]:
    """Return them."""
    started_s = time.time()

    def info(_caller: Caller, _params: dict[str, Any]) -> Value:
        described = None if service.machine is None else service.machine.description
        return {
            "name": service.settings.name,
            "id": service.settings.id,
            "version": VERSION,
            "host": platform.node(),
            "started_s": round(started_s, 3),
            "starts": service.starts,
            "jobs": service.folder is not None,
            "node_commands": service.settings.node_commands,
            "machine": None if described is None else _described(described),
            **_state(service),
        }

    def state(_caller: Caller, _params: dict[str, Any]) -> Value:
        return _state(service)

    def who_stops(caller: Caller, params: dict[str, Any]) -> str:
        return shown(params["who"] or caller.name)

    def stop(caller: Caller, params: dict[str, Any]) -> Value:
        service.emergency_stop(who_stops(caller, params))
        return _state(service)

    def restart(_caller: Caller, params: dict[str, Any]) -> Value:
        service.restart(firmware=params["firmware"])
        return _state(service)

    def tail(_caller: Caller, params: dict[str, Any]) -> Value:
        lines = service.log.tail(params["count"], params["after"])
        return {"lines": [dict(line) for line in lines], "last": service.log.count}

    async def config(_caller: Caller, _params: dict[str, Any]) -> Value:
        path = service.up_machine().description.path
        return await asyncio.to_thread(lambda: _sections(parse_config(path)))

    yield Method(
        "machine.info",
        Scope.WATCH,
        "Return what the machine is and can do.",
        info,
        returns=(
            Param("name", Kind.STR),
            Param("id", Kind.STR, "of this life of the service: are two addresses of the same one?"),
            Param("version", Kind.STR, "of canductor"),
            Param("host", Kind.STR, "the computer it runs on"),
            Param("started_s", Kind.FLOAT, "when the service started, since the epoch", "s"),
            Param("starts", Kind.INT, "how often the machine was started since"),
            Param("jobs", Kind.BOOL, "whether there is a job folder"),
            Param("node_commands", Kind.BOOL, "whether node.command is allowed"),
            Param("machine", Kind.MAP, "axes, limits, nodes, steppers and extruders; null before the start"),
            *_STATES,
        ),
    )
    yield Method("machine.state", Scope.WATCH, "Return the machine's state.", state, returns=_STATES)
    yield Method(
        "machine.emergency_stop",
        Scope.OPERATE,
        "Stop every node at once, ahead of everything queued.",
        stop,
        params=(Param("who", Kind.STR, "whom the log names as cause", required=False, high=_CAUSE_MAX),),
        returns=(
            *_STATES,
            Param(
                "ignored", Kind.STR, "what was wrong with the request; only if something was", required=False
            ),
        ),
        urgent=True,
        stops=who_stops,
    )
    yield Method(
        "machine.restart",
        Scope.OPERATE,
        "Read the configuration and restart the machine, after a stop, an error, or when idle.",
        restart,
        params=(
            Param(
                "firmware",
                Kind.BOOL,
                "reset all nodes, also those whose configuration is the same",
                required=False,
                default=False,
            ),
        ),
        returns=_STATES,
    )
    yield Method(
        "log.tail",
        Scope.WATCH,
        'Return the newest lines of the log; new ones come as notifications "log".',
        tail,
        params=(
            Param("count", Kind.INT, "most lines", required=False, default=100, low=1, high=KEEP),
            Param("after", Kind.INT, "only lines numbered above", required=False, default=0, low=0),
        ),
        returns=(
            Param("lines", Kind.LIST, "maps of number, time (UTC), kind and text; oldest first"),
            Param("last", Kind.INT, "number of the newest line"),
        ),
    )
    yield Method(
        "config.get",
        Scope.WATCH,
        "Return the configuration file as it is read, includes and saved values merged.",
        config,
        returns=(
            Param("file", Kind.STR),
            Param("sections", Kind.MAP, "by section: its options with their values, as written"),
        ),
    )


def _state(service: MachineService) -> dict[str, Value]:
    return {"state": str(service.state), "cause": service.cause}


def _described(described: MachineDescription) -> Value:
    limits = described.limits
    return {
        "config": Path(described.path).name,
        "axes": {
            axis: {"low_mm": limits.position_min[i], "high_mm": limits.position_max[i]}
            for i, axis in enumerate("xyz")
        },
        "max_velocity_mm_s": limits.max_velocity,
        "max_accel_mm_s2": limits.max_accel,
        "nodes": [node.name for node in described.nodes],
        "steppers": [
            {"name": s.name, "node": s.node, "step_distance_mm": s.step_distance} for s in described.steppers
        ],
        "extruders": [extruder.name for extruder in described.extruders],
    }


def _sections(config: ConfigFile) -> Value:
    return {
        "file": Path(config.path).name,
        "sections": {
            section.name: {option.name: option.value for option in section.options.values()}
            for section in config.sections.values()
        },
    }

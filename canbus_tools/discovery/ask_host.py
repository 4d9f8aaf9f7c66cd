"""Queries the coordinators that run on this computer for the nodes that they drive.

Uses their socket and the encoding for scripts, lines of JSON (docs/ipc.md).
"""

import asyncio
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from canbus_tools.bus.open_bus import BusOptions
from canbus_tools.discovery.node_info import Firmware, NodeInfo
from nodes.bus.assign import AssignError, Uuid
from nodes.support.errors import CanductorError
from nodes.support.host_sockets import host_sockets

TIMEOUT_S: Final = 1.0
LINE_MAX: Final = 1 << 20
_REQUESTS: Final = (
    {"id": 1, "method": "api.hello", "params": {"version": 1, "client": "canductor can", "scope": "watch"}},
    {"id": 2, "method": "nodes.list"},
)


async def ask_hosts(options: BusOptions, timeout_s: float = TIMEOUT_S) -> dict[int, NodeInfo]:
    """Return what this user's coordinators report about their nodes on a bus, by node id.

    Waits for at most TIMEOUT_S.
    """
    answers = await asyncio.gather(*(_ask(path, timeout_s) for path in host_sockets()))
    bus = _bus_name(options)
    infos: dict[int, NodeInfo] = {}
    for node in (node for nodes in answers for node in nodes if isinstance(node, Mapping)):
        nodeid = node.get("nodeid")
        if node.get("bus") == bus and isinstance(nodeid, int):
            infos[nodeid] = _facts(node)
    return infos


def _bus_name(options: BusOptions) -> str:
    """Return the name of the bus in a coordinator's configuration."""
    if options.interface == "socketcan":
        return options.channel
    interface = "virtual" if options.interface == "canductor" else options.interface
    return f"{interface}:{options.channel}"


async def _ask(path: Path, timeout_s: float) -> list[object]:
    """Return the nodes that the coordinator at PATH lists; none if there is no valid answer."""
    try:
        async with asyncio.timeout(timeout_s):
            reader, writer = await asyncio.open_unix_connection(path, limit=LINE_MAX)
            try:
                writer.write(b"".join(json.dumps(request).encode() + b"\n" for request in _REQUESTS))
                while line := await reader.readline():
                    answer = json.loads(line)
                    if answer.get("id") == _REQUESTS[-1]["id"]:
                        return list(answer["result"]["nodes"])
            finally:
                writer.close()
    # The socket is stale, or belongs to another program.
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return []
    return []


def _facts(node: Mapping[str, object]) -> NodeInfo:
    uuid, clock_hz, nodeid = node.get("uuid"), node.get("clock_freq_hz"), node.get("nodeid")
    try:
        known = Uuid.parse(uuid) if isinstance(uuid, str) else None
    except (AssignError, CanductorError):
        known = None
    state = node.get("state")
    return NodeInfo(
        firmware=Firmware(
            mcu=_text(node, "mcu"),
            version=_text(node, "firmware_version"),
            app=_text(node, "firmware"),
            build="",
            clock_hz=clock_hz if isinstance(clock_hz, int) else None,
            bitrate=None,
        ),
        uuid=known,
        believed_nodeid=nodeid if isinstance(nodeid, int) else None,
        configured=state == "ready",
        shut_down=state == "shutdown",
    )


def _text(node: Mapping[str, object], name: str) -> str:
    value = node.get(name)
    return value if isinstance(value, str) else ""

"""Methods about nodes and buses; the one that sends raw commands is off unless it is asked for."""

from collections.abc import Iterator
from typing import Any, Final

from coordinator.ipc.protocol.methods import ApiError, Caller, Kind, Method, Param, Scope
from coordinator.ipc.server.state import FieldFilter
from coordinator.service.core.machine_service import MachineService
from coordinator.service.state.figures import field_name
from coordinator.support.values import Value
from nodes.dictionary.message_format import Message
from nodes.node.node import Node
from nodes.support.errors import CanductorError

_COMMAND_MAX: Final = 512
_NAME_MAX: Final = 128


def node_methods(service: MachineService) -> Iterator[Method]:
    """Return them."""

    def nodes(_caller: Caller, _params: dict[str, Any]) -> Value:
        return {"nodes": _shown(service, "nodes", service.up_machine().nodes)}

    def buses(_caller: Caller, _params: dict[str, Any]) -> Value:
        return {"buses": _shown(service, "buses", service.up_machine().bus_stats())}

    async def command(caller: Caller, params: dict[str, Any]) -> Value:
        if not service.settings.node_commands:
            raise ApiError("not_allowed", "raw commands are off; start canductor with --node-commands")
        node = service.up_machine().nodes.get(params["node"])
        if node is None:
            raise ApiError(
                "bad_params", f"there is no node {params['node']!r}; nodes.list returns those that there are"
            )
        service.log.add("notice", f"{caller.name} sends node {node.name}: {params['command']}")
        answer = await _send(node, params["command"], params["response"])
        return {"response": None if answer is None else _plain(answer)}

    yield Method(
        "nodes.list",
        Scope.WATCH,
        "Return all nodes with what the host knows of them.",
        nodes,
        returns=(Param("nodes", Kind.LIST, "maps of the fields under nodes.<name> of the state"),),
    )
    yield Method(
        "buses.list",
        Scope.WATCH,
        "Return all buses with their counters and loads.",
        buses,
        returns=(Param("buses", Kind.LIST, "maps of the fields under buses.<name> of the state"),),
    )
    yield Method(
        "node.command",
        Scope.ADMIN,
        "Send one raw command to a node, which can ruin a job and the machine; off without --node-commands.",
        command,
        params=(
            Param("node", Kind.STR, "its name", high=_NAME_MAX),
            Param(
                "command",
                Kind.STR,
                "name parameter=value …, as the firmware's dictionary has it",
                high=_COMMAND_MAX,
            ),
            Param("response", Kind.STR, "name of the response to wait for", required=False, high=_NAME_MAX),
        ),
        returns=(Param("response", Kind.MAP, "its parameters by name, buffers as hex; null without one"),),
    )


def _shown(service: MachineService, kind: str, names: dict[str, Any]) -> Value:
    """Return the fields of KIND that the tree shows, one map for each of NAMES."""
    found: list[Value] = []
    for name in names:
        prefix = f"{kind}.{field_name(name)}."
        fields = service.tree.snapshot(FieldFilter([f"{prefix}*"])).values
        found.append({path.removeprefix(prefix): value for path, value in fields.items()})
    return found


async def _send(node: Node, text: str, response: str | None) -> Message | None:
    """Send TEXT and return the answer; raises ApiError."""
    try:
        messages = node.dictionary.decode_commands(node.dictionary.encode_text(text))
        assert messages is not None
        sent = messages[0]
        if response is None:
            node.send(sent.name, **sent.params)  # type: ignore[arg-type]
            return None
        return await node.query(sent.name, response, **sent.params)  # type: ignore[arg-type]
    except CanductorError as error:
        raise ApiError("failed", str(error)) from None


def _plain(message: Message) -> Value:
    return {name: v.hex() if isinstance(v, bytes) else v for name, v in message.params.items()}

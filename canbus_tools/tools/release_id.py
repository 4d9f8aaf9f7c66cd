"""``canductor can release UUID|NODEID``: resets a node, so that it waits for an id again."""

import argparse
import asyncio
import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from canbus_tools.bus.computer import Computer
from canbus_tools.bus.open_bus import BusOptions, bus_options, declare_bus
from canbus_tools.bus.talk import LISTEN_S, BusTalk, TalkError, in_use, on_bus, refuse_if_in_use
from canbus_tools.discovery.ask_bus import declare_listen, discover_nodes
from canbus_tools.discovery.inventory import NodePresence, take_inventory
from canbus_tools.discovery.node_discovery import DiscoveredNodes, WaitingNode
from canbus_tools.tools.assign_id import parse_uuid
from canbus_tools.tools.query import application_name
from nodes.bus.assign import AssignError, Uuid
from nodes.support.can_protocol import LAST_NODEID, UUID_SIZE
from nodes.support.errors import CanductorError
from nodes.support.option_values import parse_int

RESET: Final = "reset"
LEAVE_S: Final = 0.3
"""Time for the acknowledgement of the reset command, which a node may omit."""
RETURN_S: Final = 6.0
"""Longest time that a board takes to start, through its bootloader."""


def declare(command: argparse.ArgumentParser) -> None:
    """Add the options."""
    command.add_argument("node", type=_node, metavar="UUID|NODEID", help="uuid of the node, or its id")
    declare_bus(command)
    declare_listen(command)
    command.add_argument(
        "--force",
        action="store_true",
        help="release the node even if another program uses it; that program loses the node",
    )


def make_job(given: argparse.Namespace) -> Callable[[Computer], "ReleaseReport"]:
    """Return the job; raises UsageError."""
    bus = bus_options(given)
    return lambda computer: on_bus(
        computer, bus, lambda talk: release(talk, given.node, force=given.force, listen_s=given.listen)
    )


def _node(given: str) -> Uuid | int:
    text = given.strip()
    # A uuid has 12 digits, an id at most 3; anything else is probably a mistyped uuid.
    if text.isascii() and text.isdecimal() and len(text) < 2 * UUID_SIZE:
        return parse_int(text, 1, LAST_NODEID)
    return parse_uuid(text)


@dataclass(frozen=True, slots=True)
class ReleaseReport:
    """A node that waits for an id."""

    bus: BusOptions
    node: WaitingNode
    nodeid: int | None = None
    """The id that it had, if any."""
    ok: bool = True

    def to_json(self) -> Mapping[str, object]:
        """Return all of it."""
        return {
            "bus": self.bus.name,
            "uuid": str(self.node.uuid),
            "nodeid": self.nodeid,
            "application": self.node.application.value,
            "waited_before": self.nodeid is None,
        }

    def to_text(self) -> str:
        """Return one line."""
        waits = "waits for an id already" if self.nodeid is None else "was reset and waits for an id now"
        had = "" if self.nodeid is None else f"had id {self.nodeid}, "
        return f"{self.node.uuid} {had}{waits} ({application_name(self.node)})"


async def release(
    bus: BusTalk, node: Uuid | int, *, force: bool = False, listen_s: float = LISTEN_S
) -> ReleaseReport:
    """Reset NODE and wait until it waits for an id again; raises CanductorError with what to do."""
    before = await discover_nodes(bus)
    if isinstance(node, int):
        nodeid = node
        if not force:
            await refuse_if_in_use(bus, nodeid, listen_s)
    else:
        waits = next((waiting for waiting in before.waiting if waiting.uuid == node), None)
        if waits is not None and node not in before.twins:
            return ReleaseReport(bus.options, waits)
        nodeid = await _find(bus, node, before, force=force, listen_s=listen_s)
    uuid = await _reset(bus, nodeid)
    expected = uuid or (node if isinstance(node, Uuid) else None)
    returned = await _returned(bus, nodeid, expected, before)
    return ReleaseReport(bus.options, returned, nodeid)


async def _find(bus: BusTalk, uuid: Uuid, discovery: DiscoveredNodes, *, force: bool, listen_s: float) -> int:
    """Return the id of the node UUID, which no other program uses; raises CanductorError."""
    ours = {node.nodeid for node in discovery.here if node.uuid == uuid}
    if force and len(ours) == 1:
        return ours.pop()
    found = [
        entry
        for entry in (await take_inventory(bus, listen_s=listen_s)).by_uuid(uuid)
        if entry.nodeid is not None
    ]
    if len(found) > 1 or any(entry.twins for entry in found):
        raise AssignError(
            f"two boards on {bus.name} have the uuid {uuid} (cloned chips?); disconnect one of them, or name "
            "one by its id"
        )
    if not found or found[0].nodeid is None:
        raise AssignError(
            f"no node with the uuid {uuid} was found on {bus.name}; 'canductor can nodes "
            f"{bus.options.arguments}' lists all nodes; name a node that another program uses by its id"
        )
    if found[0].state is NodePresence.IN_USE:
        raise TalkError(in_use(bus.name, found[0].nodeid))
    return found[0].nodeid


async def _reset(bus: BusTalk, nodeid: int) -> Uuid | None:
    """Reset the node; return its uuid if its firmware reports one."""
    async with bus.node(nodeid) as talk:
        if RESET not in talk.dictionary.commands or talk.dictionary.commands[RESET].names:
            raise AssignError(
                f"the firmware of node {nodeid} on {bus.name} ({talk.dictionary.version}) has no reset "
                "command; switch the node off and on"
            )
        uuid: Uuid | None = None
        if talk.knows("get_canbus_id", "canbus_id"):
            answer = (await talk.ask("get_canbus_id", "canbus_id")).message.params.get("canbus_uuid")
            uuid = Uuid(answer) if isinstance(answer, bytes) and len(answer) == UUID_SIZE else None
        talk.send(RESET)
        with contextlib.suppress(TimeoutError, CanductorError):  # it may reset without an acknowledgement
            await asyncio.wait_for(talk.drained(), LEAVE_S)
        return uuid


async def _returned(bus: BusTalk, nodeid: int, uuid: Uuid | None, before: DiscoveredNodes) -> WaitingNode:
    """Wait until the node waits for an id; without a UUID, it is the one that did not wait BEFORE."""
    known = {node.uuid for node in before.waiting}
    loop = asyncio.get_running_loop()
    deadline_s = loop.time() + RETURN_S
    while loop.time() < deadline_s:
        found = await discover_nodes(bus, rounds=1)
        for node in found.waiting:
            if node.uuid == uuid or (uuid is None and node.uuid not in known):
                return node
    raise AssignError(
        f"node {uuid or nodeid} on {bus.name} was reset, but does not wait for an id after {RETURN_S:g} s; "
        "check whether another host assigned one again, else switch it off and on"
    )

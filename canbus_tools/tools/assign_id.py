"""``canductor can assign UUID NODEID``: assigns an id to a node that waits for one, and verifies it."""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Final

from canbus_tools.bus.computer import Computer
from canbus_tools.bus.open_bus import BusOptions, bus_options, declare_bus
from canbus_tools.bus.talk import LISTEN_S, BusTalk, on_bus
from canbus_tools.discovery.ask_bus import declare_listen, discover_nodes
from canbus_tools.discovery.inventory import PROBED, Inventory, NodePresence, take_inventory
from canbus_tools.discovery.node_info import NodeInfo, read_node_info
from nodes.bus.assign import AssignError, Uuid
from nodes.support.can_protocol import ADMIN_ID, FIRST_NODEID, LAST_NODEID, SET_NODEID
from nodes.support.option_values import UsageError, integer

TRIES: Final = 3
"""Attempts: an id is not acknowledged, and frames get lost."""


def declare(command: argparse.ArgumentParser) -> None:
    """Add the options."""
    add = command.add_argument
    add("uuid", type=parse_uuid, metavar="UUID", help="12 hex digits, as printed by 'canductor can query'")
    add(
        "nodeid",
        type=integer(FIRST_NODEID, LAST_NODEID),
        metavar="NODEID",
        help=f"id to assign, {FIRST_NODEID} to {LAST_NODEID}",
    )
    declare_bus(command)
    declare_listen(command)


def make_job(given: argparse.Namespace) -> Callable[[Computer], "AssignReport"]:
    """Return the job; raises UsageError."""
    bus = bus_options(given)
    return lambda computer: on_bus(
        computer, bus, lambda talk: assign(talk, given.uuid, given.nodeid, listen_s=given.listen)
    )


def parse_uuid(text: str) -> Uuid:
    """Return the uuid of an option; raises UsageError."""
    try:
        return Uuid.parse(text)
    except AssignError:
        raise UsageError(
            f"is '{text}', must be the 12 hex digits that 'canductor can query' prints"
        ) from None


@dataclass(frozen=True, slots=True, kw_only=True)
class AssignReport:
    """A node that has its id."""

    bus: BusOptions
    uuid: Uuid
    nodeid: int
    facts: NodeInfo
    had_it: bool
    ok: bool = True

    def to_json(self) -> Mapping[str, object]:
        """Return all of it."""
        return {
            "bus": self.bus.name,
            "uuid": str(self.uuid),
            "nodeid": self.nodeid,
            "had_it_before": self.had_it,
            "firmware": asdict(self.facts.firmware),
        }

    def to_text(self) -> str:
        """Return one line."""
        firmware = self.facts.firmware
        has = "had id {} before" if self.had_it else "has id {} now"
        return f"{self.uuid} {has.format(self.nodeid)}: {firmware.mcu}, {firmware.app} {firmware.version}"


async def assign(bus: BusTalk, uuid: Uuid, nodeid: int, *, listen_s: float = LISTEN_S) -> AssignReport:
    """Assign the id NODEID to the node UUID; raises CanductorError with what to do.

    LISTEN_S: time to listen for other hosts first.
    """
    # Only the inventory finds the uuids of nodes that have an id; a second board with this uuid would take
    # the id as well.
    found = await take_inventory(bus, probed={*PROBED, nodeid}, listen_s=listen_s)
    had_it = _check_node(bus, uuid, nodeid, found)
    if not had_it:
        _check_id(bus, nodeid, found)
        await _send_id(bus, uuid, nodeid)
    facts = await read_node_info(bus, nodeid)
    if facts.uuid not in (None, uuid):
        raise AssignError(
            f"{uuid} was assigned id {nodeid}, but {facts.uuid} answers on it; switch both off and on"
        )
    return AssignReport(bus=bus.options, uuid=uuid, nodeid=nodeid, facts=facts, had_it=had_it)


def _check_node(bus: BusTalk, uuid: Uuid, nodeid: int, found: Inventory) -> bool:
    """Return whether UUID has the id already; raises AssignError if the id cannot be assigned to it."""
    boards = found.by_uuid(uuid)
    if not boards:
        waiting = ", ".join(str(node.uuid) for node in found.discovery.waiting) or "none"
        raise AssignError(
            f"node {uuid} was not found on {bus.name} (nodes that wait for an id: {waiting}); compare the "
            "uuid, and check the node's power, cable and bit rate: "
            f"'canductor can query {bus.options.arguments}' explains how"
        )
    board = boards[0]
    if len(boards) > 1 or board.twins:
        raise AssignError(
            f"two boards on {bus.name} have the uuid {uuid} (cloned chips?), and both would take the id; "
            "disconnect one of them"
        )
    if board.state is NodePresence.BOOTLOADER:
        raise AssignError(
            f"node {uuid} runs its bootloader (Katapult), which takes no id; flash it, or reset it to start "
            "its firmware"
        )
    if board.nodeid not in (None, nodeid):
        raise AssignError(
            f"node {uuid} has id {board.nodeid} already; 'canductor can release {board.nodeid} "
            f"{bus.options.arguments}' releases it"
        )
    if board.state is NodePresence.IN_USE:
        raise AssignError(f"node {uuid} on {bus.name} has id {nodeid} already, and another program uses it")
    return board.nodeid == nodeid


def _check_id(bus: BusTalk, nodeid: int, found: Inventory) -> None:
    """Raise AssignError if another node has the id: that node would shut down."""
    owners = {entry.nodeid: entry.uuid for entry in found.entries if entry.nodeid is not None}
    taken = set(owners) | bus.hosted | bus.talking
    if nodeid in taken:
        free = next((str(n) for n in range(FIRST_NODEID, LAST_NODEID + 1) if n not in taken), "none")
        owner = owners.get(nodeid) or "another node"
        raise AssignError(
            f"id {nodeid} on {bus.name} belongs to {owner}, which would shut down; the id {free} is free"
        )


async def _send_id(bus: BusTalk, uuid: Uuid, nodeid: int) -> None:
    """Send the node its id until it no longer waits for one; raises AssignError."""
    for _ in range(TRIES):
        bus.send_frame(ADMIN_ID, bytes((SET_NODEID, *uuid.raw, nodeid)))
        found = await discover_nodes(bus, rounds=2)
        if all(node.uuid != uuid for node in found.waiting):
            return
    raise AssignError(
        f"the id {nodeid} was sent to node {uuid} on {bus.name} {TRIES} times, and it still waits for one; "
        f"check with 'canductor can doctor {bus.options.arguments}' whether frames get lost, or two boards "
        "have this uuid"
    )

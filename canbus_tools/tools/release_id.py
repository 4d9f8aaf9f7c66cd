"""``canductor can release UUID|NODEID``: resets a node, so that it waits for an id again."""

import argparse
import asyncio
import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from canbus_tools.bus.computer import Computer
from canbus_tools.bus.open_bus import BusOptions, bus_options, declare_bus
from canbus_tools.bus.talk import LISTEN_S, BusTalk, TalkError, in_use, refuse_if_in_use
from canbus_tools.discovery.ask_bus import declare_listen, discover_nodes, where
from canbus_tools.discovery.inventory import NodePresence, take_inventory
from canbus_tools.discovery.node_discovery import Application, DiscoveredNodes, WaitingNode
from canbus_tools.tools.assign_id import parse_uuid
from canbus_tools.tools.query import application_name
from nodes.bus.assign import AssignError, Uuid
from nodes.support.can_protocol import LAST_NODEID, UUID_SIZE
from nodes.support.errors import CanductorError
from nodes.support.option_values import parse_int

RESET: Final = "reset"
LEAVE_S: Final = 0.3
"""A node resets when it has acknowledged the command, or without doing so."""
RETURN_S: Final = 6.0
"""How long a board may take to start, through its bootloader."""


def declare(command: argparse.ArgumentParser) -> None:
    """Add the options."""
    command.add_argument("node", type=_node, metavar="UUID|NODEID", help="uuid of the node, or its id")
    declare_bus(command)
    declare_listen(command)
    command.add_argument(
        "--force",
        action="store_true",
        help="release the node even if another program uses it; that program loses it",
    )


def make_job(given: argparse.Namespace) -> Callable[[Computer], "ReleaseReport"]:
    """Return the job; raises UsageError."""
    bus = bus_options(given)
    return lambda computer: release(computer, bus, given.node, force=given.force, listen_s=given.listen)


def _node(given: str) -> Uuid | int:
    text = given.strip()
    # A uuid has 12 digits, an id at most 3; what is neither is most likely a uuid with a digit amiss.
    if text.isascii() and text.isdecimal() and len(text) < 2 * UUID_SIZE:
        return parse_int(text, 1, LAST_NODEID)
    return parse_uuid(text)


def release(
    computer: Computer,
    options: BusOptions,
    node: Uuid | int,
    *,
    force: bool = False,
    listen_s: float = LISTEN_S,
) -> "ReleaseReport":
    """Reset NODE and wait until it asks for an id again; raises CanductorError with what to do."""

    async def run() -> ReleaseReport:
        async with BusTalk.open(computer, options) as bus:
            return await release_on(bus, node, force=force, listen_s=listen_s)

    return computer.run(run())


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleaseReport:
    """The node waits."""

    bus: BusOptions
    uuid: Uuid
    application: Application
    text: str
    nodeid: int | None
    """The id it had; None: it had none."""
    ok: bool = True

    def to_json(self) -> Mapping[str, object]:
        """Return all of it."""
        return {
            "bus": self.bus.name,
            "uuid": str(self.uuid),
            "nodeid": self.nodeid,
            "application": self.application.value,
            "waited_before": self.nodeid is None,
        }

    def to_text(self) -> str:
        """Return one line."""
        return self.text


async def release_on(
    bus: BusTalk, node: Uuid | int, *, force: bool = False, listen_s: float = LISTEN_S
) -> ReleaseReport:
    """Reset NODE on an open bus, as ``release`` does."""
    before = await discover_nodes(bus)
    if isinstance(node, int):
        nodeid = node
        if not force:
            await refuse_if_in_use(bus, nodeid, listen_s)
    else:
        waits = _waiting(before, node)
        if waits is not None and node not in before.twins:
            return _report(bus, waits, None)
        nodeid = await _find(bus, node, before, force=force, listen_s=listen_s)
    uuid = await _reset(bus, nodeid)
    expected = uuid or (node if isinstance(node, Uuid) else None)
    returned = await _returned(bus, nodeid, expected, before)
    return _report(bus, returned, nodeid)


def _report(bus: BusTalk, node: WaitingNode, nodeid: int | None) -> ReleaseReport:
    what = application_name(node)
    if nodeid is None:
        text = f"{node.uuid} waits for an id already ({what})"
    else:
        text = f"{node.uuid} had id {nodeid}, was reset and waits for an id now ({what})"
    return ReleaseReport(
        bus=bus.options, uuid=node.uuid, application=node.application, text=text, nodeid=nodeid
    )


def _waiting(discovery: DiscoveredNodes, uuid: Uuid) -> WaitingNode | None:
    return next((node for node in discovery.waiting if node.uuid == uuid), None)


async def _find(bus: BusTalk, uuid: Uuid, discovery: DiscoveredNodes, *, force: bool, listen_s: float) -> int:
    """Return the id that UUID has, and that nobody else uses; raises CanductorError."""
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
            f"two boards on {bus.name} have the uuid {uuid} (cloned chips?); take one of them off, or name "
            "one by its id"
        )
    if not found or found[0].nodeid is None:
        raise AssignError(
            f"no node on {bus.name} that can be asked has the uuid {uuid}; "
            f"'canductor can nodes {where(bus.options)}' lists them, and a node that another program talks "
            "to can be named by its id"
        )
    if found[0].state is NodePresence.IN_USE:
        raise TalkError(in_use(bus.name, found[0].nodeid))
    return found[0].nodeid


async def _reset(bus: BusTalk, nodeid: int) -> Uuid | None:
    """Reset the node; return its uuid if its firmware reports one."""
    async with bus.node(nodeid) as talk:
        if RESET not in talk.dictionary.commands or talk.dictionary.commands[RESET].names:
            raise AssignError(
                f"the firmware of node {nodeid} on {bus.name} ({talk.dictionary.version}) has no command to "
                "reset it; switch it off and on"
            )
        uuid: Uuid | None = None
        if talk.knows("get_canbus_id", "canbus_id"):
            answer = (await talk.ask("get_canbus_id", "canbus_id")).message.params.get("canbus_uuid")
            uuid = Uuid(answer) if isinstance(answer, bytes) and len(answer) == UUID_SIZE else None
        talk.send_text(RESET)
        with contextlib.suppress(TimeoutError, CanductorError):  # it may reset without an acknowledgement
            await asyncio.wait_for(talk.drained(), LEAVE_S)
        return uuid


async def _returned(bus: BusTalk, nodeid: int, uuid: Uuid | None, before: DiscoveredNodes) -> WaitingNode:
    """Wait until the node asks for an id; one whose uuid is not known is whoever did not wait before."""
    known = {node.uuid for node in before.waiting}
    loop = asyncio.get_running_loop()
    deadline_s = loop.time() + RETURN_S
    while loop.time() < deadline_s:
        found = await discover_nodes(bus, rounds=1)
        for node in found.waiting:
            if node.uuid == uuid or (uuid is None and node.uuid not in known):
                return node
    raise AssignError(
        f"node {uuid or nodeid} on {bus.name} was reset and does not wait for an id after "
        f"{RETURN_S:g} s; another host may have given it one again, else switch it off and on"
    )

"""Everything alive on a bus, with an id or without, and what it is.

It listens first: ids to which another host sends belong to that host, and nothing is sent to them. Nodes on
all other ids are found by a damaged block: a node answers it with the number of the next block that it
expects, executes nothing and changes nothing. Nodes that answer are queried.
"""

import asyncio
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

from canbus_tools.bus.talk import LISTEN_S, BusTalk
from canbus_tools.discovery.ask_bus import discover_nodes
from canbus_tools.discovery.ask_host import ask_hosts
from canbus_tools.discovery.node_discovery import ROUNDS, Application, DiscoveredNodes, NodeHere, WaitingNode
from canbus_tools.discovery.node_info import NodeInfo, read_node_info
from canbus_tools.discovery.passive_discovery import PassiveDiscovery
from canbus_tools.protocol.protocol import Direction, data_id, owner_of
from nodes.bus.assign import Uuid
from nodes.link import Frame
from nodes.support.can_protocol import FIRST_NODEID
from nodes.support.errors import CanductorError

PROBED: Final = range(FIRST_NODEID, 68)
"""Hosts assign 4, 5, 6, …; higher ids are tried if they were heard, or on request."""
DAMAGED_BLOCK: Final = b"\x05\x10\x00\x00\x7e\x7e"
"""An empty block with a wrong checksum; the second sync byte is for parsers that search for the next one."""
PROBE_PASSES: Final = 3
"""Attempts, as frames get lost; without discovery, one answer is the only sign of a node."""
PROBES_AT_ONCE: Final = 4
PROBE_PAUSE_S: Final = 0.002
"""Pause after so many: uses a fifth of the bus at 1 Mbit/s, all of it for 40 ms at 250 kbit/s."""
PROBE_ANSWER_S: Final = 0.03
"""Time for the last answers; adapters on USB may delay frames by 16 ms."""
READ_AT_ONCE: Final = 8
HEAR_OUT_S: Final = 0.1
HEAR_OUT_TIMES: Final = 22
"""A host that queries clocks every 0.98 s has then done so three times since the start."""


class NodePresence(Enum):
    """State of a node, as far as it is known."""

    WAITING = "waiting"
    BOOTLOADER = "bootloader"
    IN_USE = "in use"
    """Another host uses it, so it was not queried."""
    IDLE = "idle"
    """It has an id and no configuration."""
    CONFIGURED = "configured"
    """It has a configuration, but no host uses it."""
    SHUTDOWN = "shutdown"
    UNCLEAR = "unclear"
    """``trouble`` has the reason."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InventoryEntry:
    """One node."""

    nodeid: int | None
    uuid: Uuid | None
    application: Application
    state: NodePresence
    facts: NodeInfo | None = None
    twins: bool = False
    """Another board has the same uuid."""
    reported: NodeInfo | None = None
    """Of a node in use: what its coordinator reports."""
    passive: NodeInfo | None = None
    """Of a node in use: what its traffic shows, by a dictionary in the cache that explains it."""
    trouble: str = ""


@dataclass(frozen=True, slots=True)
class Inventory:
    """All nodes that were found, by id, followed by those that wait for one."""

    entries: tuple[InventoryEntry, ...]
    discovery: DiscoveredNodes
    probed: tuple[int, ...]
    """Ids to which a damaged block was sent."""

    @property
    def boards(self) -> int:
        """Minimum number of boards: twins that answer identically are one entry."""
        rows = Counter(entry.uuid for entry in self.entries)
        return len(self.entries) + sum(entry.twins and rows[entry.uuid] == 1 for entry in self.entries)

    def by_uuid(self, uuid: Uuid) -> list[InventoryEntry]:
        """Return the nodes that have a uuid."""
        return [entry for entry in self.entries if entry.uuid == uuid]


async def take_inventory(
    bus: BusTalk, *, probed: Iterable[int] = PROBED, listen_s: float = LISTEN_S, rounds: int = ROUNDS
) -> Inventory:
    """Find all nodes on BUS, after listening for LISTEN_S; raises CanductorError if the bus fails."""
    started_s = asyncio.get_running_loop().time()
    discovery = await discover_nodes(bus, rounds)
    await bus.wait(max(0.0, started_s + listen_s - asyncio.get_running_loop().time()))
    here = {node.nodeid for node in discovery.here}
    candidates = tuple(sorted({*probed, *here, *bus.talking} - bus.hosted))
    answering = await probe(bus, candidates)
    hosted = frozenset(bus.hosted)
    shared = _shared_ids(discovery)
    # A node that answered WHO_IS_HERE is queried even if it answered no probe: queries are repeated.
    asked = sorted((answering | here) - hosted - shared)
    facts = dict(zip(asked, await _read_all_node_info(bus, asked), strict=True))
    silent = {n for n in here - answering if isinstance(facts.get(n), CanductorError)}
    entries = [_assigned(n, facts[n], discovery, silent=n in silent) for n in asked]
    entries += [_not_asked(node, shared) for node in discovery.here if node.nodeid not in facts]
    entries += [_hosted(nodeid, answers=nodeid in bus.talking) for nodeid in sorted(hosted - here)]
    entries.sort(key=lambda entry: (entry.nodeid or 0, entry.uuid.raw if entry.uuid else b""))
    entries += [_waiting(node) for node in await _still_waiting(bus, discovery, {e.uuid for e in entries})]
    return Inventory(_mark_twins(entries), discovery, candidates)


async def take_full_inventory(
    bus: BusTalk, *, probed: Iterable[int] = PROBED, listen_s: float = LISTEN_S
) -> Inventory:
    """Find all nodes; of nodes in use, add what their host reports, or else what their traffic shows."""
    passive = PassiveDiscovery(bus.cache)
    end = bus.on_frame(passive.frame)
    try:
        found = await take_inventory(bus, probed=probed, listen_s=listen_s)
        reported = await ask_hosts(bus.options)
        await _listen_out(bus, frozenset(bus.hosted - reported.keys()), passive)
    finally:
        end()
    entries = [_in_use(entry, reported, passive) for entry in found.entries]
    return replace(found, entries=_mark_twins(entries))


async def _listen_out(bus: BusTalk, hosted: Iterable[int], passive: PassiveDiscovery) -> None:
    """Wait for a second clock report of a node if that may identify it."""
    for _ in range(HEAR_OUT_TIMES):
        if not any(passive.is_open(nodeid) for nodeid in hosted):
            return
        await bus.wait(HEAR_OUT_S)


def _in_use(
    entry: InventoryEntry, reported: Mapping[int, NodeInfo], passive: PassiveDiscovery
) -> InventoryEntry:
    if entry.state is not NodePresence.IN_USE or entry.nodeid is None:
        return entry
    if info := reported.get(entry.nodeid):
        return replace(entry, reported=info, uuid=entry.uuid or info.uuid)
    facts = passive.facts(entry.nodeid)
    uuid = entry.uuid or (facts.uuid if facts else None)
    return replace(entry, passive=facts, uuid=uuid)


async def _still_waiting(
    bus: BusTalk, discovery: DiscoveredNodes, with_id: Collection[Uuid | None]
) -> Iterable[WaitingNode]:
    """Return the waiting nodes, without boards to which another host has assigned an id meanwhile.

    A uuid that was also found with an id must still wait: then it belongs to a second board.
    """
    if not any(node.uuid in with_id for node in discovery.waiting):
        return discovery.waiting
    now = {node.uuid for node in (await discover_nodes(bus)).waiting}
    return [node for node in discovery.waiting if node.uuid not in with_id or node.uuid in now]


async def probe(bus: BusTalk, nodeids: Iterable[int]) -> set[int]:
    """Send a damaged block to each of NODEIDS that no other host uses; return those that answered."""
    wanted = set(nodeids)
    answered: set[int] = set()

    def came(frame: Frame) -> None:
        owner = owner_of(frame.can_id)
        if owner is not None and owner[1] is Direction.FROM_NODE:
            answered.add(owner[0])

    end = bus.on_frame(came)
    try:
        for _ in range(PROBE_PASSES):
            for number, nodeid in enumerate(sorted(wanted - answered)):
                if number % PROBES_AT_ONCE == 0:
                    await bus.wait(PROBE_PAUSE_S)
                if nodeid not in bus.hosted:
                    bus.send_frame(data_id(nodeid, Direction.TO_NODE), DAMAGED_BLOCK)
            await bus.wait(PROBE_ANSWER_S)
    finally:
        end()
    return answered & wanted


async def _read_all_node_info(bus: BusTalk, nodeids: list[int]) -> list[NodeInfo | CanductorError]:
    """Query all, a few at a time, or one at a time if a host uses the bus; a failure is a node's result."""
    room = asyncio.Semaphore(1 if bus.hosted else READ_AT_ONCE)

    async def one(nodeid: int) -> NodeInfo | CanductorError:
        async with room:
            try:
                return await read_node_info(bus, nodeid)
            except CanductorError as error:
                return error

    return list(await asyncio.gather(*(one(nodeid) for nodeid in nodeids)))


# --------------------------------------------------------------------------------------------------- entries


def _shared_ids(discovery: DiscoveredNodes) -> frozenset[int]:
    """Return the ids that more than one board has; their answers would be mixed up."""
    boards = Counter(node.nodeid for node in discovery.here)
    twins = {node.nodeid for node in discovery.here if node.twins}
    return frozenset(twins | {nodeid for nodeid, count in boards.items() if count > 1})


def _assigned(
    nodeid: int, said: NodeInfo | CanductorError, discovery: DiscoveredNodes, *, silent: bool
) -> InventoryEntry:
    ours = next((node for node in discovery.here if node.nodeid == nodeid), None)
    application = Application.CANDUCTOR if ours else Application.KLIPPER
    if isinstance(said, CanductorError):
        uuid = ours.uuid if ours else None
        trouble = "it reports its presence, but does not answer on its id" if silent else str(said)
        return InventoryEntry(
            nodeid=nodeid, uuid=uuid, application=application, state=NodePresence.UNCLEAR, trouble=trouble
        )
    uuid = said.uuid or (ours.uuid if ours else None)
    trouble = "" if said.configured is not None else "its firmware does not report whether it is configured"
    if said.believed_nodeid not in (None, nodeid):
        trouble = f"it answers on id {nodeid}, but reports the id {said.believed_nodeid}"
    elif ours and uuid != ours.uuid:
        trouble = (
            f"two boards answer on this id: {ours.uuid} and {uuid}; switch both off and on, and let only one "
            "host assign ids"
        )
    return InventoryEntry(
        nodeid=nodeid, uuid=uuid, application=application, state=_state(said), facts=said, trouble=trouble
    )


def _state(facts: NodeInfo) -> NodePresence:
    if facts.shut_down:
        return NodePresence.SHUTDOWN
    if facts.configured is None:
        return NodePresence.UNCLEAR
    return NodePresence.CONFIGURED if facts.configured else NodePresence.IDLE


def _not_asked(node: NodeHere, shared: frozenset[int]) -> InventoryEntry:
    """Return a node with our firmware that has a host or shares its id."""
    both = "more than one board has this id; switch them off and on, and let only one host assign ids"
    is_shared = node.nodeid in shared
    return InventoryEntry(
        nodeid=node.nodeid,
        uuid=node.uuid,
        application=Application.CANDUCTOR,
        state=NodePresence.UNCLEAR if is_shared else NodePresence.IN_USE,
        twins=node.twins,
        trouble=both if is_shared else "",
    )


def _hosted(nodeid: int, *, answers: bool) -> InventoryEntry:
    """Return a node that is known only by its traffic."""
    silent = "another program sends to this id, but no node answers"
    return InventoryEntry(
        nodeid=nodeid,
        uuid=None,
        application=Application.KLIPPER if answers else Application.UNKNOWN,
        state=NodePresence.IN_USE if answers else NodePresence.UNCLEAR,
        trouble="" if answers else silent,
    )


def _waiting(node: WaitingNode) -> InventoryEntry:
    state = NodePresence.BOOTLOADER if node.application is Application.KATAPULT else NodePresence.WAITING
    return InventoryEntry(
        nodeid=None, uuid=node.uuid, application=node.application, state=state, twins=node.twins
    )


def _mark_twins(entries: list[InventoryEntry]) -> tuple[InventoryEntry, ...]:
    boards = Counter(entry.uuid for entry in entries if entry.uuid is not None)
    return tuple(
        replace(entry, twins=entry.twins or (entry.uuid is not None and boards[entry.uuid] > 1))
        for entry in entries
    )

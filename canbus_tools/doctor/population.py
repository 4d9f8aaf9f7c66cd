"""Checks of the nodes."""

from collections import defaultdict
from collections.abc import Iterator
from typing import Final

from canbus_tools.bus.open_bus import BusOptions
from canbus_tools.discovery.inventory import InventoryEntry, NodePresence
from canbus_tools.doctor.facts import NodeFacts, PingFacts
from canbus_tools.doctor.finding import Finding, note, problem, warning
from canbus_tools.doctor.traffic import RTT_SPREAD_S, slow
from nodes.support.can_protocol import FIRST_NODEID, LAST_NODEID

SAID_ACTIVE: Final = "active"
LOSS_MANY: Final = 0.02
NODE_ERRORS: Final = 96
"""Value of a node's error counters from which a controller is in the state "warning"."""


def check_nodes(facts: NodeFacts, bus: BusOptions) -> Iterator[Finding]:
    """Check which nodes there are, and their state."""
    entries = facts.inventory.entries
    if not entries:
        yield _no_nodes(facts, bus)
    yield from _twins(entries)
    yield from _shared_ids(facts, entries)
    free = _free_id(facts)
    for entry in entries:
        yield from _node(entry, bus, free)
    for nodeid, said in facts.silenced.items():
        yield _went_silent(nodeid, said, bus)
    for ping in facts.pings:
        yield from _ping(ping, bus)


def _no_nodes(facts: NodeFacts, bus: BusOptions) -> Finding:
    best = max(facts.heard_at.items(), key=lambda item: item[1], default=(0, 0))
    if best[1]:
        return problem(
            "other-bitrate",
            f"no node answers on {bus.name} at its bit rate, but {best[1]} frames were heard at {best[0]}"
            " bit/s",
            "the nodes run at another bit rate than this interface",
            f"sudo ip link set {bus.name} down; sudo ip link set {bus.name} up type can bitrate {best[0]}"
            " restart-ms 100"
            if bus.is_socketcan
            else f"give --bitrate {best[0]}",
        )
    tried = ", ".join(map(str, facts.heard_at))
    at = f" at {bus.bitrate} bit/s" if bus.bitrate else ""
    return problem(
        "no-nodes",
        f"0 uuids found: no node answers on {bus.name}{at}"
        + (f"; nothing heard at {tried} either" if tried else ""),
        "the nodes have no power, are cut off, were built for another bit rate (CANBUS_FREQUENCY) or for "
        "USB, or run no firmware at all",
        "check power, CANH and CANL, two terminators of 120 ohm (60 between the wires), and the bit rate "
        f"in the nodes' firmware settings; then ask again: 'canductor can query {bus.arguments}'",
    )


def _twins(entries: tuple[InventoryEntry, ...]) -> Iterator[Finding]:
    uuids = dict.fromkeys(entry.uuid for entry in entries if entry.twins and entry.uuid is not None)
    for uuid in uuids:
        yield problem(
            "duplicate-uuid",
            f"more than one board answers with the uuid {uuid}",
            "their chips have the same serial number (cloned chips), or one wrote the other's: a host "
            "cannot tell them apart, and both would take one id",
            "disconnect one of them, or build its firmware with a different uuid",
        )


def _shared_ids(facts: NodeFacts, entries: tuple[InventoryEntry, ...]) -> Iterator[Finding]:
    boards: dict[int, set[str]] = defaultdict(set)
    for node in facts.inventory.discovery.here:
        boards[node.nodeid].add(str(node.uuid))
    for entry in entries:
        if entry.nodeid is not None and entry.uuid is not None:
            boards[entry.nodeid].add(str(entry.uuid))
    for nodeid, uuids in boards.items():
        if len(uuids) > 1:
            yield problem(
                "duplicate-nodeid",
                f"node id {nodeid} is used by more than one board: {', '.join(sorted(uuids))}",
                "both act on every command and their answers collide; two hosts gave out ids, or a board "
                "kept its id when another host began",
                "stop all hosts but one, switch these boards off and on, and let that one host give out the"
                " ids",
            )


def _free_id(facts: NodeFacts) -> int:
    taken = {entry.nodeid for entry in facts.inventory.entries}
    return next(nodeid for nodeid in range(FIRST_NODEID, LAST_NODEID + 2) if nodeid not in taken)


def _went_silent(nodeid: int, said: str, bus: BusOptions) -> Finding:
    return problem(
        "node-went-silent",
        f"node {nodeid} answered its first queries, but no further ones: {said}",
        "while it was asked it was reset, lost its power, or its controller went off the bus (bus-off); when"
        " several nodes fall silent together, this computer's adapter may have",
        f"look whether it is back: 'canductor can nodes {bus.arguments}'. If it waits for an id, it was "
        "reset: look at its power; if it has its id, look at its cable, its crimp and the termination",
    )


def _node(entry: InventoryEntry, bus: BusOptions, free: int) -> Iterator[Finding]:
    name = _name(entry)
    if entry.state is NodePresence.SHUTDOWN:
        yield warning(
            "node-shutdown",
            f"{name} is in shutdown",
            "an error or an emergency stop made it shut down; it does nothing until it is reset",
            "restart its host (FIRMWARE_RESTART in Klipper), or talk to it: 'canductor console "
            f"{bus.arguments} --node {entry.nodeid}', and there: reset",
        )
    elif entry.state is NodePresence.BOOTLOADER:
        yield warning(
            "node-in-bootloader",
            f"{name} is in its bootloader (Katapult)",
            "its firmware did not start, or the bootloader was requested: no host can use it",
            f"flash it (flashtool.py -u {entry.uuid}), or press reset once",
        )
    elif entry.state is NodePresence.WAITING and not entry.twins:
        yield note(
            "node-waits",
            f"{name} waits for an id",
            "that is normal while no host runs that has this node in its configuration",
            "put its uuid into the host's configuration; to try it:"
            f" 'canductor can assign {entry.uuid} {free} {bus.arguments}'",
        )
    elif entry.state is NodePresence.UNCLEAR and entry.trouble and "more than one board" not in entry.trouble:
        yield warning(
            "node-unclear",
            f"{name}: {entry.trouble}",
            "its state could not be read",
            f"switch it off and on, then check again: 'canductor can nodes {bus.arguments}'",
        )
    status = entry.facts.can if entry.facts is not None else None
    if status is not None and (
        status.state != SAID_ACTIVE or max(status.rx_errors, status.tx_errors) >= NODE_ERRORS
    ):
        yield warning(
            "node-can-errors",
            f"{name} reports: error counters {status.rx_errors} receiving, {status.tx_errors} sending,"
            f" {status.tx_retries} retries, bus state {status.state}",
            "its connection to the bus is bad: its crimp, its stub, or a terminator near it",
            "swap its cable with that of a good node, and check whether the errors follow the "
            "cable or the board",
        )


def _ping(ping: PingFacts, bus: BusOptions) -> Iterator[Finding]:
    if ping.lost or ping.invalid_bytes:
        found = problem if ping.lost > LOSS_MANY * ping.asked else warning
        yield found(
            "frames-lost",
            f"of {ping.asked} queries to node {ping.nodeid}, {ping.lost} got lost without a trace, and"
            f" {ping.invalid_bytes} bytes of its answers were no valid block ({ping.repeats} blocks were"
            " repeated)",
            "frames get lost between this program and the node. On the wire controllers repeat what was "
            "damaged, so it is the adapter, the kernel, or the node's receive buffer",
            f"look at the counters: ip -details -statistics link show {bus.name}; try another USB port, "
            "cable or adapter, and a kernel of 6.6 or newer",
        )
    if ping.rtt_p99_s > RTT_SPREAD_S:
        yield slow(ping.nodeid, ping.rtt_median_s, ping.rtt_p99_s, f"{ping.asked} queries")


def _name(entry: InventoryEntry) -> str:
    uuid = "" if entry.uuid is None else f"{entry.uuid}"
    return f"node {entry.nodeid} ({uuid or 'uuid unknown'})" if entry.nodeid is not None else f"board {uuid}"

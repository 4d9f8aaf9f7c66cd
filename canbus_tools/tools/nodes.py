"""``canductor can nodes``: lists all nodes that answer, and their properties."""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Final

from canbus_tools.bus.computer import Computer
from canbus_tools.bus.open_bus import BusOptions, bus_options, declare_bus
from canbus_tools.bus.talk import on_bus
from canbus_tools.discovery.ask_bus import declare_listen
from canbus_tools.discovery.inventory import (
    PROBED,
    Inventory,
    InventoryEntry,
    NodePresence,
    take_full_inventory,
)
from canbus_tools.discovery.node_discovery import Application
from canbus_tools.support.text_table import count, paragraph, table
from nodes.support.can_protocol import LAST_NODEID
from nodes.support.option_values import UsageError, parse_int

HEADINGS: Final = (
    "id",
    "uuid",
    "application",
    "state",
    "MCU",
    "clock",
    "firmware",
    "up",
    "rx/tx errors",
    "retries",
    "bus",
)
NAMES: Final[Mapping[Application, str]] = {
    Application.KLIPPER: "Klipper-type",
    Application.CANDUCTOR: "canductor",
    Application.KATAPULT: "Katapult",
    Application.UNKNOWN: "unknown",
}
STATES: Final[Mapping[NodePresence, str]] = {
    NodePresence.WAITING: "waits for an id",
    NodePresence.BOOTLOADER: "in its bootloader",
    NodePresence.IN_USE: "in use by a host",
    NodePresence.IDLE: "idle",
    NodePresence.CONFIGURED: "configured",
    NodePresence.SHUTDOWN: "SHUT DOWN",
    NodePresence.UNCLEAR: "unclear",
}


def declare(command: argparse.ArgumentParser) -> None:
    """Add the options."""
    declare_bus(command)
    add = command.add_argument
    add(
        "--probe",
        type=_ids,
        metavar="IDS",
        default=PROBED,
        help=f"node ids to query, such as 4 or 4-12; 'none' only listens and queries by uuid, for a bus"
        f" shared with other protocols (default: {PROBED.start}-{PROBED[-1]})",
    )
    declare_listen(command)


def make_job(given: argparse.Namespace) -> Callable[[Computer], "NodesReport"]:
    """Return the job; raises UsageError."""
    bus = bus_options(given)
    return lambda computer: NodesReport(
        bus,
        on_bus(
            computer, bus, lambda talk: take_full_inventory(talk, probed=given.probe, listen_s=given.listen)
        ),
    )


def _ids(text: str) -> range:
    if text.strip() == "none":
        return range(0)
    first, dash, last = text.partition("-")
    low = parse_int(first, 1, LAST_NODEID)
    high = parse_int(last, 1, LAST_NODEID) if dash else low
    if low > high:
        raise UsageError(f"is '{text}', must go from the lower id to the higher")
    return range(low, high + 1)


@dataclass(frozen=True, slots=True)
class NodesReport:
    """All nodes that were found."""

    bus: BusOptions
    found: Inventory
    ok: bool = True

    def to_json(self) -> Mapping[str, object]:
        """Return all of it."""
        return {
            "bus": self.bus.name,
            "nodes": [entry_json(entry) for entry in self.found.entries],
            "duplicate_uuids": sorted({str(entry.uuid) for entry in self.found.entries if entry.twins}),
            "probed": list(self.found.probed),
            "foreign_frames": self.found.discovery.foreign_frames,
        }

    def to_text(self) -> str:
        """Return the table, and what to know about it."""
        entries = self.found.entries
        lines = [f"{count(self.found.boards, 'node')} on {self.bus.name}", ""]
        if not entries:
            return "\n".join(lines + _no_nodes(self.bus, self.found))
        lines += [*table(HEADINGS, [_row(entry) for entry in entries]), ""]
        notes = _notes(self.found, self.bus)
        return "\n".join(lines + [line for note in notes for line in paragraph(note)]).rstrip()


def entry_json(entry: InventoryEntry) -> dict[str, object]:
    """Return one node with all that is known of it."""
    facts = entry.facts or entry.reported or entry.passive
    return {
        "nodeid": entry.nodeid,
        "uuid": None if entry.uuid is None else str(entry.uuid),
        "application": entry.application.value,
        "state": entry.state.value,
        "several_boards": entry.twins,
        "trouble": entry.trouble or None,
        "reported_by_host": entry.reported is not None,
        "guessed": entry.passive is not None,
        "firmware": None if facts is None else asdict(facts.firmware),
        "uptime_s": None if facts is None else facts.uptime_s,
        "configured": None if facts is None else facts.configured,
        "shut_down": None if facts is None else facts.shut_down,
        "can": None if facts is None or facts.can is None else asdict(facts.can),
    }


def _row(entry: InventoryEntry) -> list[str]:
    row = [
        "-" if entry.nodeid is None else str(entry.nodeid),
        "?" if entry.uuid is None else str(entry.uuid),
        NAMES[entry.application],
        STATES[entry.state] + (", two boards!" if entry.twins else ""),
    ]
    facts = entry.facts or entry.reported or entry.passive
    if facts is None:
        return row + [""] * (len(HEADINGS) - len(row))
    firmware, can = facts.firmware, facts.can
    return [
        *row,
        firmware.mcu + (" ?" if entry.passive else ""),
        "" if firmware.clock_hz is None else f"{firmware.clock_hz / 1e6:g} MHz",
        " ".join(filter(None, (firmware.app, firmware.version))),
        duration(facts.uptime_s),
        "" if can is None else f"{can.rx_errors}/{can.tx_errors}",
        "" if can is None else str(can.tx_retries),
        "" if can is None else can.state,
    ]


def duration(seconds: float | None) -> str:
    """Return a time as text: 12 s, 3 min, 4.5 h, 6.2 d."""
    if seconds is None:
        return ""
    if seconds < 100:
        return f"{seconds:.0f} s"
    if seconds < 6000:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 48 * 3600 else f"{seconds / 86400:.1f} d"


def _notes(found: Inventory, bus: BusOptions) -> list[str]:
    entries = found.entries
    notes = [f"Node {_name(entry)}: {entry.trouble}." for entry in entries if entry.trouble]
    if twins := sorted({str(entry.uuid) for entry in entries if entry.twins}):
        notes.append(
            f"Two boards have the uuid {', '.join(twins)} (cloned chips?): they cannot be used on one bus. "
            "Disconnect one of them."
        )
    for entry in entries:
        if entry.state is NodePresence.SHUTDOWN:
            notes.append(
                f"Node {_name(entry)} is shut down until its host restarts it; "
                f"'canductor can release {entry.nodeid} {bus.arguments}' resets it."
            )
        if entry.state is NodePresence.BOOTLOADER:
            notes.append(f"Node {_name(entry)} runs its bootloader: flash it, or reset it.")
    if any(entry.state is NodePresence.IN_USE for entry in entries):
        notes.append(
            "Nodes in use were not queried, to avoid disturbing their host. A coordinator reports the nodes "
            "that it drives; of other hosts' nodes the uuid is known if they run canductor's firmware."
        )
    if any(entry.passive for entry in entries):
        notes.append(
            "Rows with '?' were guessed: a dictionary in the cache explains the traffic of the node and its "
            "host."
        )
    elif any(entry.state is NodePresence.IN_USE for entry in entries):
        notes.append(
            "Their traffic identifies them if their dictionary is in the cache: run this command once while "
            "their host is stopped."
        )
    return notes


def _name(entry: InventoryEntry) -> str:
    return str(entry.uuid) if entry.nodeid is None else str(entry.nodeid)


def _no_nodes(bus: BusOptions, found: Inventory) -> list[str]:
    tried = f"ids {found.probed[0]} to {found.probed[-1]}" if found.probed else "no ids (--probe none)"
    lines = paragraph(
        "No node waits for an id, none reports that it has one, no host was heard that uses one, and none "
        f"of {tried} answered."
    )
    if found.discovery.foreign_frames:
        lines += paragraph(
            f"The bus works: {count(found.discovery.foreign_frames, 'frame')} of other protocols were seen."
        )
    return lines + paragraph(
        f"'canductor can query {bus.arguments}' lists what to check; 'canductor can doctor {bus.arguments}' "
        "checks the bus."
    )

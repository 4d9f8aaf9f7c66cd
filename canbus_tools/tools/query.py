"""``canductor can query``: which nodes wait for an id, and what they are."""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from canbus_tools.bus.computer import Computer
from canbus_tools.bus.open_bus import BusOptions, bus_options, declare_bus
from canbus_tools.bus.talk import on_bus
from canbus_tools.discovery.ask_bus import discover_nodes
from canbus_tools.discovery.node_discovery import ROUNDS, Application, DiscoveredNodes, WaitingNode
from canbus_tools.support.text_table import count, paragraph, table
from nodes.support.option_values import integer

NAMES: Final[Mapping[Application, str]] = {
    Application.KLIPPER: "Klipper-type firmware",
    Application.CANDUCTOR: "canductor firmware",
    Application.KATAPULT: "Katapult bootloader",
    Application.UNKNOWN: "unknown",
}
_ROUNDS_MAX: Final = 1000


def declare(command: argparse.ArgumentParser) -> None:
    """Add the options."""
    declare_bus(command)
    command.add_argument(
        "--rounds",
        type=integer(1, _ROUNDS_MAX),
        metavar="N",
        default=ROUNDS,
        help="number of queries; answers can collide or get lost",
    )


def make_job(given: argparse.Namespace) -> Callable[[Computer], "QueryReport"]:
    """Return the job; raises UsageError."""
    bus = bus_options(given)
    return lambda computer: query(computer, bus, given.rounds)


def query(computer: Computer, options: BusOptions, rounds: int = ROUNDS) -> "QueryReport":
    """Find the nodes that wait for an id; changes nothing in any node. Raises CanductorError."""
    started_ns = computer.monotonic_ns()
    found = on_bus(computer, options, lambda bus: discover_nodes(bus, rounds))
    return QueryReport(options, found, (computer.monotonic_ns() - started_ns) * 1e-9)


@dataclass(frozen=True, slots=True)
class QueryReport:
    """The nodes that wait for an id."""

    bus: BusOptions
    found: DiscoveredNodes
    took_s: float
    ok: bool = True

    def to_json(self) -> Mapping[str, object]:
        """Return all of it."""
        return {
            "bus": self.bus.name,
            "rounds": self.found.rounds,
            "took_s": round(self.took_s, 3),
            "nodes": [
                {
                    "uuid": str(node.uuid),
                    "application": node.application.value,
                    "set_command": node.set_command,
                    "answers": node.answers,
                    "several_boards": node.twins,
                }
                for node in self.found.waiting
            ],
            "duplicate_uuids": [str(uuid) for uuid in self.found.twins],
            "assigned_nodeids": assigned_ids(self.found),
        }

    def to_text(self) -> str:
        """Return the table, and what to know about it."""
        found = self.found
        asked = f"asked {count(found.rounds, 'time')} in {self.took_s:.1f} s"
        waits = count(len(found.waiting), "uuid waits", "uuids wait")
        lines = [f"{waits} for an id on {self.bus.name} ({asked})"]
        if found.waiting:
            rows = [
                [
                    str(node.uuid),
                    application_name(node),
                    str(node.answers),
                    "two boards!" if node.twins else "",
                ]
                for node in found.waiting
            ]
            lines += ["", *table(("uuid", "application", "answers", ""), rows), ""]
            lines += _notes(found)
        else:
            lines += ["", *_why_none(found, self.bus)]
        return "\n".join(lines)


def application_name(node: WaitingNode) -> str:
    """Return the name of a waiting node's application."""
    if node.application is Application.UNKNOWN:
        return f"unknown (its id is set by command 0x{node.set_command:02x})"
    return NAMES[node.application]


def assigned_ids(found: DiscoveredNodes) -> list[int]:
    """Return the node ids that were seen in use."""
    return sorted({node.nodeid for node in found.here} | found.hosted | found.talking)


def _notes(found: DiscoveredNodes) -> list[str]:
    notes: list[str] = []
    if found.twins:
        uuids = ", ".join(str(uuid) for uuid in found.twins)
        notes.append(
            f"Two boards have the uuid {uuids} (cloned chips, or a copied chip id): they would get the same "
            "id and destroy each other's frames. Disconnect one: they cannot be used on the same bus."
        )
    kinds = {node.application for node in found.waiting}
    if Application.KLIPPER in kinds:
        notes.append(
            "Klipper-type: Klipper's firmware or canductor's own. Without an id both answer alike; with one, "
            "'canductor can nodes' distinguishes them."
        )
    if Application.KATAPULT in kinds:
        notes.append(
            "Katapult: the board waits to be flashed, or its firmware did not start. Flash it, or reset it "
            "to start its firmware."
        )
    notes.append("Nodes that have an id do not answer: 'canductor can nodes' lists those as well.")
    return [line for note in notes for line in paragraph(note)]


def _why_none(found: DiscoveredNodes, bus: BusOptions) -> list[str]:
    """Explain why no node answered, which is usually no fault."""
    ids = assigned_ids(found)
    lines = []
    if ids:
        lines.append(
            f"The bus works: {count(len(ids), 'node')} with an id {'was' if len(ids) == 1 else 'were'} heard "
            f"({', '.join(map(str, ids))}), and only nodes without one answer this query."
        )
    else:
        lines.append("Only nodes without an id answer this query. A node keeps the id that a host assigned")
        lines.append("until it is reset or switched off.")
    lines.append(f"  'canductor can nodes {bus.arguments}' lists nodes with an id too.")
    lines.append(f"  'canductor can release NODEID {bus.arguments}' makes a node wait for an id again.")
    if not ids:
        lines += [
            "",
            "If no node is found at all, check in this order:",
            "  power        the board's LED is on; USB alone does not always power its CAN transceiver",
            "  firmware     flashed, and built for CAN on the pins of the board's CAN connector",
            "  bit rate     the same for host and all nodes; a node with another one is never heard and may",
            "               disturb the bus. Firmware is built for one: usually 1000000, 500000 or 250000",
            "  wiring       CANH to CANH, CANL to CANL, not crossed like a serial line",
            "  termination  120 ohm at each end, none between: 60 ohm from CANH to CANL, power off",
            f"  'canductor can doctor {bus.arguments}' checks what can be checked from here.",
        ]
    return lines

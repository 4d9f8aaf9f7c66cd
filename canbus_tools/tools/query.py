"""``canductor can query``: which nodes wait for an id, and what they are."""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from canbus_tools.bus.computer import Computer
from canbus_tools.bus.open_bus import BusOptions, bus_options, declare_bus
from canbus_tools.bus.talk import BusTalk
from canbus_tools.discovery.ask_bus import discover_nodes, where
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
    """Ask who waits; changes nothing in any node. Raises CanductorError."""
    started_ns = computer.monotonic_ns()

    async def ask() -> DiscoveredNodes:
        async with BusTalk.open(computer, options) as bus:
            return await discover_nodes(bus, rounds)

    found = computer.run(ask())
    return QueryReport(options, found, (computer.monotonic_ns() - started_ns) * 1e-9)


@dataclass(frozen=True, slots=True)
class QueryReport:
    """Who waits."""

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
            lines += ["", *_why_nobody(found, self.bus)]
        return "\n".join(lines)


def application_name(node: WaitingNode) -> str:
    """Return what a waiting node is, for people."""
    if node.application is Application.UNKNOWN:
        return f"unknown (takes its id by command 0x{node.set_command:02x})"
    return NAMES[node.application]


def assigned_ids(found: DiscoveredNodes) -> list[int]:
    """Return the node ids that were seen in use."""
    return sorted({node.nodeid for node in found.here} | found.hosted | found.talking)


def twin_note(found: DiscoveredNodes) -> str:
    """Return what two boards with one uuid mean."""
    uuids = ", ".join(str(uuid) for uuid in found.twins)
    return (
        f"Two boards have the uuid {uuids} (cloned chips, or one chip id copied): they would get the same id "
        "and destroy each other's frames. Take one off the bus; it cannot be used together with the other."
    )


def _notes(found: DiscoveredNodes) -> list[str]:
    notes: list[str] = []
    if found.twins:
        notes.append(twin_note(found))
    kinds = {node.application for node in found.waiting}
    if Application.KLIPPER in kinds:
        notes.append(
            "Klipper-type: Klipper's firmware or canductor's own. Without an id they answer alike; with one, "
            "'canductor can nodes' tells them apart."
        )
    if Application.KATAPULT in kinds:
        notes.append(
            "Katapult: the board waits to be flashed, or its firmware did not start. Flash it, or reset it "
            "to start the firmware that it has."
        )
    notes.append("Nodes that have an id do not answer: 'canductor can nodes' lists those as well.")
    return [line for note in notes for line in paragraph(note)]


def _why_nobody(found: DiscoveredNodes, bus: BusOptions) -> list[str]:
    """Explain an empty answer: most often it is no fault at all."""
    ids = assigned_ids(found)
    lines = []
    if ids:
        lines.append(
            f"The bus works: {count(len(ids), 'node')} with an id {'was' if len(ids) == 1 else 'were'} heard "
            f"({', '.join(map(str, ids))}), and only nodes without one answer this question."
        )
    else:
        lines.append(
            "Only nodes without an id answer this question. One that a host has given its id keeps it"
        )
        lines.append("until it is reset or switched off.")
    lines.append(f"  'canductor can nodes {where(bus)}' lists nodes with an id too.")
    lines.append(f"  'canductor can release NODEID {where(bus)}' makes one wait again.")
    if not ids:
        lines += [
            "",
            "Is no node there at all? Check, in this order:",
            "  power      is the board's light on; USB alone does not always power its CAN side",
            "  firmware   is it flashed, and built for CAN on the pins that its connector uses",
            "  bit rate   host and all nodes need the same; a node at another one is never heard and may",
            "             take the bus down. Firmware is built for one: 1000000, 500000 and 250000 are usual",
            "  wiring     CANH to CANH, CANL to CANL, not crossed as a serial line is",
            "  ends       a 120 ohm resistor at each end, none between: 60 ohm from CANH to CANL, power off",
            f"  'canductor can doctor {where(bus)}' checks what can be checked from here.",
        ]
    return lines

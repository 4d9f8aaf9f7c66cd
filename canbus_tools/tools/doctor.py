"""``canductor can doctor``: checks a bus, and explains what is wrong and what to do."""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from canbus_tools.bus.computer import Computer
from canbus_tools.bus.link_facts import LinkFacts, read_link
from canbus_tools.bus.open_bus import BusOptions, bus_options, declare_bus
from canbus_tools.discovery.ask_bus import where
from canbus_tools.doctor.facts import BusAddress, InterfaceFacts, NodeFacts, TrafficFacts
from canbus_tools.doctor.finding import Finding, Severity, note, problem
from canbus_tools.doctor.gather import BusListener, ask_nodes, fill_queue, read_interface, try_bitrates
from canbus_tools.doctor.interface import check_link, check_presence
from canbus_tools.doctor.population import check_nodes
from canbus_tools.doctor.traffic import check_traffic
from canbus_tools.support.text_table import count, paragraph
from nodes.support.errors import CanductorError
from nodes.support.option_values import UsageError, decimal

LISTEN_S: Final = 3.0
LISTEN_S_MIN, LISTEN_S_MAX = 0.2, 600.0
SYSTEMS_BITRATE: Final = ("socketcan", "canductor")
"""Backends that have the bit rate they have."""


def declare(command: argparse.ArgumentParser) -> None:
    """Add the options."""
    declare_bus(command)
    add = command.add_argument
    add(
        "--listen",
        type=decimal(LISTEN_S_MIN, LISTEN_S_MAX, "s"),
        default=LISTEN_S,
        metavar="S",
        help="how long to listen first, in seconds",
    )
    add("--quiet-bus", action="store_true", help="send nothing: only listen and read the interface's state")
    add(
        "--try-bitrates",
        action="store_true",
        help="if no node is found, listen at other bit rates, listen-only",
    )


def make_job(given: argparse.Namespace) -> Callable[[Computer], "Diagnosis"]:
    """Check what was given; raises UsageError."""
    options = bus_options(given)
    if given.try_bitrates and given.quiet_bus:
        raise UsageError("--try-bitrates is for a bus without nodes, which --quiet-bus does not look for")
    return lambda computer: examine(
        computer, options, given.listen, quiet=given.quiet_bus, try_others=given.try_bitrates
    )


def examine(
    computer: Computer,
    options: BusOptions,
    listen_s: float,
    *,
    quiet: bool = False,
    try_others: bool = False,
) -> "Diagnosis":
    """Gather facts and judge them; what cannot be found out is a finding, too."""
    interface: InterfaceFacts | None = None
    findings: list[Finding] = []
    done: list[str] = []
    place = BusAddress(name=options.name, words=where(options), socketcan=False, bitrate=options.bitrate)
    if options.interface == "socketcan":
        interface = read_interface(options.channel)
        findings = list(check_presence(interface))
        bitrate = options.bitrate or (None if interface.link is None else interface.link.bitrate)
        place = BusAddress(name=options.name, words=where(options), socketcan=True, bitrate=bitrate)
        done.append("interface")
        if findings:
            return Diagnosis(place.name, tuple(findings), tuple(done))
        findings += check_link(interface)
    try:
        traffic, nodes = _use_bus(computer, options, place, listen_s, quiet=quiet, try_others=try_others)
    except CanductorError as error:
        findings.append(_unusable(str(error), place))
        return Diagnosis(place.name, tuple(findings), tuple(done))
    done.append("traffic")
    findings += check_traffic(traffic, interface, place)
    if nodes is not None:
        done.append("nodes")
        findings += check_nodes(nodes, place)
        if try_others and place.socketcan and not nodes.inventory.entries:
            findings.append(_try_by_hand(place.name))
    if place.bitrate is None:
        findings.append(
            note(
                "bitrate-unknown",
                f"the bit rate of {place.name} is not known here",
                "the load of the bus cannot be computed",
                "give it, such as --bitrate 1000000",
            )
        )
    return Diagnosis(place.name, tuple(findings), tuple(done), traffic, nodes)


def _use_bus(
    computer: Computer,
    options: BusOptions,
    place: BusAddress,
    listen_s: float,
    *,
    quiet: bool,
    try_others: bool,
) -> tuple[TrafficFacts, NodeFacts | None]:
    opened = options
    if options.interface in SYSTEMS_BITRATE:
        opened = BusOptions(interface=options.interface, channel=options.channel)
    nodes: NodeFacts | None = None
    queue_full = False
    before = _counters(options)
    with BusListener(computer, opened, place.bitrate) as listener:
        listener.wait(listen_s)
        listener.end_of_calm()
        if place.socketcan and not quiet:
            queue_full = fill_queue(opened)
            # Error reports of what we send are the most telling; others have none, or but one handle.
            nodes = computer.run(ask_nodes(computer, opened))
    if not place.socketcan and not quiet:
        nodes = computer.run(ask_nodes(computer, opened))
    traffic = listener.facts(before, _counters(options), queue_full=queue_full)
    if nodes is not None and not nodes.inventory.entries and try_others and not place.socketcan:
        nodes = NodeFacts(inventory=nodes.inventory, heard_at=try_bitrates(computer, options, listen_s))
    return traffic, nodes


def _counters(options: BusOptions) -> LinkFacts | None:
    return read_link(options.channel) if options.interface == "socketcan" else None


def _try_by_hand(name: str) -> Finding:
    return note(
        "bitrates-by-hand",
        "other bit rates were not tried",
        "the bit rate of a SocketCAN interface is the system's to change",
        f"for 500000, 250000 and 1000000 in turn: sudo ip link set {name} down; sudo ip link set {name} up "
        f"type can bitrate 500000 listen-only on; then 'canductor can load -c {name}': at the right one "
        "there are frames. At the end: listen-only off",
    )


def _unusable(said: str, place: BusAddress) -> Finding:
    if "ermission denied" in said or "not permitted" in said:
        return problem(
            "no-permission",
            said,
            "this user may not open the bus, so nothing more can be checked",
            f"sudo canductor can doctor {place.words}; inside a container, give it the host's network and the"
            " capability NET_RAW",
        )
    return problem(
        "bus-unusable",
        said,
        "the bus could not be used, so not everything was checked",
        f"put right what is said there, and ask again: 'canductor can doctor {place.words}'",
    )


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """All findings, the worst first."""

    bus: str
    findings: tuple[Finding, ...]
    checked: tuple[str, ...]
    traffic: TrafficFacts | None = None
    nodes: NodeFacts | None = None

    @property
    def ok(self) -> bool:
        """Whether nothing but notes was found."""
        return all(finding.severity is Severity.NOTE for finding in self.findings)

    @property
    def sorted(self) -> list[Finding]:
        """The findings, the worst first."""
        return sorted(self.findings, key=lambda finding: list(Severity).index(finding.severity))

    def to_json(self) -> Mapping[str, object]:
        """Return the findings, and the figures that they come from."""
        load = None if self.traffic is None or self.traffic.load is None else round(self.traffic.load.mean, 6)
        pings = () if self.nodes is None else self.nodes.pings
        return {
            "bus": self.bus,
            "checked": list(self.checked),
            "findings": [
                {
                    "name": finding.name,
                    "severity": finding.severity.value,
                    "seen": finding.seen,
                    "means": finding.means,
                    "do": finding.do,
                }
                for finding in self.sorted
            ],
            "load": load,
            "nodes": None if self.nodes is None else len(self.nodes.inventory.entries),
            "pings": [
                {
                    "nodeid": ping.nodeid,
                    "asked": ping.asked,
                    "repeats": ping.repeats,
                    "lost": ping.lost,
                    "invalid_bytes": ping.invalid_bytes,
                    "rtt_median_s": round(ping.rtt_median_s, 6),
                    "rtt_p99_s": round(ping.rtt_p99_s, 6),
                }
                for ping in pings
                if ping.asked
            ],
        }

    def to_text(self) -> str:
        """Return it as text to be read by people."""
        lines = [f"{self.bus}: {self._summary()}"]
        for finding in self.sorted:
            lines += ["", f"{finding.severity.value.upper()} {finding.name}"]
            for label, text in (("seen", finding.seen), ("means", finding.means), ("do", finding.do)):
                first, *rest = paragraph(text)
                lines += [f"  {label:6}{first}", *(f"        {line}" for line in rest)]
        lines += ["", *self._figures()]
        return "\n".join(lines).rstrip()

    def _summary(self) -> str:
        counts = {
            severity: sum(finding.severity is severity for finding in self.findings) for severity in Severity
        }
        said = [count(number_of, severity.value) for severity, number_of in counts.items() if number_of]
        if not said and self.nodes is None and self.traffic is not None and not self.traffic.frames:
            return "nothing was heard and nothing was asked, so no node was checked"
        return ", ".join(said) or "nothing is wrong"

    def _figures(self) -> list[str]:
        lines = []
        if self.traffic is not None:
            load = self.traffic.load
            busy = "how busy it is needs --bitrate" if load is None else f"{load.mean:.1%} busy"
            lines.append(f"listened {self.traffic.listened_s:.1f} s: {busy}")
        pings = () if self.nodes is None else self.nodes.pings
        return lines + [
            f"node {ping.nodeid}: {ping.asked} questions, {ping.repeats} repeated; round trip"
            f" {ping.rtt_median_s * 1000:.2f} ms median, {ping.rtt_p99_s * 1000:.2f} ms p99"
            for ping in pings
            if ping.asked
        ]

"""``canductor can doctor``: checks a bus, and explains what is wrong and what to do."""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Final

from canbus_tools.bus.computer import Computer
from canbus_tools.bus.link_facts import LinkFacts, read_link
from canbus_tools.bus.open_bus import BusOptions, bus_options, declare_bus
from canbus_tools.bus.talk import on_bus
from canbus_tools.doctor.facts import InterfaceFacts, NodeFacts, TrafficFacts
from canbus_tools.doctor.finding import Finding, Severity, note, problem
from canbus_tools.doctor.gather import BusListener, fill_queue, query_nodes, read_interface, try_bitrates
from canbus_tools.doctor.interface import check_link, check_presence
from canbus_tools.doctor.population import check_nodes
from canbus_tools.doctor.traffic import check_traffic
from canbus_tools.support.text_table import count, paragraph
from nodes.support.errors import CanductorError
from nodes.support.option_values import UsageError, decimal

LISTEN_S: Final = 3.0
LISTEN_S_MIN, LISTEN_S_MAX = 0.2, 600.0


def declare(command: argparse.ArgumentParser) -> None:
    """Add the options."""
    declare_bus(command)
    add = command.add_argument
    add(
        "--listen",
        type=decimal(LISTEN_S_MIN, LISTEN_S_MAX, "s"),
        default=LISTEN_S,
        metavar="S",
        help="time to listen before sending, in seconds",
    )
    add("--quiet-bus", action="store_true", help="send nothing; only listen and read the interface's state")
    add(
        "--try-bitrates",
        action="store_true",
        help="if no node is found, listen at other bit rates, listen-only",
    )


def make_job(given: argparse.Namespace) -> Callable[[Computer], "Diagnosis"]:
    """Check what was given; raises UsageError."""
    options = bus_options(given)
    if given.try_bitrates and given.quiet_bus:
        raise UsageError("--try-bitrates needs to look for nodes, which --quiet-bus does not do")
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
    """Gather facts and check them; what cannot be determined is a finding, too."""
    interface: InterfaceFacts | None = None
    findings: list[Finding] = []
    done: list[str] = []
    if options.is_socketcan:
        interface = read_interface(options.channel)
        findings = list(check_presence(interface))
        done.append("interface")
        if findings:
            return Diagnosis(options.name, tuple(findings), tuple(done))
        assert interface.link is not None
        options = replace(options, bitrate=options.bitrate or interface.link.bitrate)
        findings += check_link(interface)
    try:
        traffic, nodes = _use_bus(computer, options, listen_s, quiet=quiet, try_others=try_others)
    except CanductorError as error:
        findings.append(_unusable(str(error), options))
        return Diagnosis(options.name, tuple(findings), tuple(done))
    done.append("traffic")
    findings += check_traffic(traffic, interface, options)
    if nodes is not None:
        done.append("nodes")
        findings += check_nodes(nodes, options)
        if try_others and options.is_socketcan and not nodes.inventory.entries:
            findings.append(_try_by_hand(options.name))
    if options.bitrate is None:
        findings.append(
            note(
                "bitrate-unknown",
                f"the bit rate of {options.name} is not known here",
                "the load of the bus cannot be computed",
                "give the bit rate, such as --bitrate 1000000",
            )
        )
    return Diagnosis(options.name, tuple(findings), tuple(done), traffic, nodes)


def _use_bus(
    computer: Computer, options: BusOptions, listen_s: float, *, quiet: bool, try_others: bool
) -> tuple[TrafficFacts, NodeFacts | None]:
    opened = options.without_bitrate()
    nodes: NodeFacts | None = None
    queue_full = False
    before = _counters(options)
    with BusListener(computer, opened, options.bitrate) as listener:
        listener.wait(listen_s)
        listener.start_of_queries()
        if options.is_socketcan and not quiet:
            queue_full = fill_queue(opened)
            # Listens meanwhile for error reports; other backends have none, or can be opened only once.
            nodes = on_bus(computer, opened, query_nodes)
    if not options.is_socketcan and not quiet:
        nodes = on_bus(computer, opened, query_nodes)
    traffic = listener.facts(before, _counters(options), queue_full=queue_full)
    if nodes is not None and not nodes.inventory.entries and try_others and not options.is_socketcan:
        nodes = NodeFacts(inventory=nodes.inventory, heard_at=try_bitrates(computer, options, listen_s))
    return traffic, nodes


def _counters(options: BusOptions) -> LinkFacts | None:
    return read_link(options.channel) if options.is_socketcan else None


def _try_by_hand(name: str) -> Finding:
    return note(
        "bitrates-by-hand",
        "other bit rates were not tried",
        "only the system can change the bit rate of a SocketCAN interface",
        f"for 500000, 250000 and 1000000 in turn: sudo ip link set {name} down; sudo ip link set {name} up "
        f"type can bitrate 500000 listen-only on; then 'canductor can load -c {name}': at the right one "
        "there are frames. At the end: listen-only off",
    )


def _unusable(message: str, bus: BusOptions) -> Finding:
    if "ermission denied" in message or "not permitted" in message:
        return problem(
            "no-permission",
            message,
            "this user may not open the bus, so nothing more can be checked",
            f"sudo canductor can doctor {bus.arguments}; a container needs the host's network and the"
            " capability NET_RAW",
        )
    return problem(
        "bus-unusable",
        message,
        "the bus could not be used, so not everything was checked",
        f"correct that cause, then check again: 'canductor can doctor {bus.arguments}'",
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
            "findings": [asdict(finding) for finding in self.sorted],
            "load": load,
            "nodes": None if self.nodes is None else len(self.nodes.inventory.entries),
            "pings": [
                asdict(ping)
                | {"rtt_median_s": round(ping.rtt_median_s, 6), "rtt_p99_s": round(ping.rtt_p99_s, 6)}
                for ping in pings
                if ping.asked
            ],
        }

    def to_text(self) -> str:
        """Return the findings as text."""
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
            return "no frame was received and nothing was sent, so no node was checked"
        return ", ".join(said) or "nothing is wrong"

    def _figures(self) -> list[str]:
        lines = []
        if self.traffic is not None:
            load = self.traffic.load
            busy = "load unknown without --bitrate" if load is None else f"load {load.mean:.1%}"
            lines.append(f"listened {self.traffic.listened_s:.1f} s: {busy}")
        pings = () if self.nodes is None else self.nodes.pings
        return lines + [
            f"node {ping.nodeid}: {ping.asked} queries, {ping.repeats} repeated; round trip"
            f" {ping.rtt_median_s * 1000:.2f} ms median, {ping.rtt_p99_s * 1000:.2f} ms p99"
            for ping in pings
            if ping.asked
        ]

"""Checks of the traffic."""

from collections.abc import Iterator
from typing import Final

from canbus_tools.bus.open_bus import BusOptions
from canbus_tools.doctor.facts import DirectionFacts, InterfaceFacts, TrafficFacts
from canbus_tools.doctor.finding import Finding, note, problem, warning
from canbus_tools.doctor.interface import CABLE
from canbus_tools.doctor.known_faults import CANDLELIGHT_FAULT, CANDLELIGHT_USB

LOAD_HIGH: Final = 0.7
LOAD_FULL: Final = 0.9
REPEATS_MANY: Final = 0.01
"""Of another host's blocks."""
RTT_SPREAD_S: Final = 0.02
"""With a higher p99, commands that are sent shortly before their time may be late."""
WIRE_ERRORS: Final = ("form", "stuff", "bit")


def check_traffic(
    facts: TrafficFacts, interface: InterfaceFacts | None, bus: BusOptions
) -> Iterator[Finding]:
    """Check the observed traffic."""
    yield from _load(facts, bus)
    yield from _errors(facts)
    yield from _lost(facts, bus)
    for way in facts.nodes:
        yield from _node(way, interface)
    if facts.other_frames:
        yield note(
            "other-protocol",
            f"{facts.other_frames} of {facts.frames} frames belong to no node of this protocol",
            "another protocol shares the bus; that works, but uses part of its capacity",
            f"list its ids: 'canductor can load {bus.arguments}'",
        )


def _load(facts: TrafficFacts, bus: BusOptions) -> Iterator[Finding]:
    if facts.load is None or facts.load.mean < LOAD_HIGH:
        return
    load = facts.load
    busiest = max(load.classes.items(), key=lambda item: item[1].bits)
    seen = f"the load of the bus is {load.mean:.0%}, most of it from the class '{busiest[0].value}'"
    do = (
        f"find the cause of the load: 'canductor can load {bus.arguments} --watch'; a higher bit rate (all "
        "nodes have to be flashed for it), or a second bus for some of the nodes, makes room"
    )
    if load.mean >= LOAD_FULL:
        means = "frames with high ids are delayed: nodes and hosts receive late, up to time-outs"
        yield problem("bus-overloaded", seen, means, do)
    else:
        yield warning("bus-busy", seen, "bursts already wait for each other, and errors leave no reserve", do)


def _errors(facts: TrafficFacts) -> Iterator[Finding]:
    if facts.errors.get("bus off"):
        yield problem(
            "went-bus-off",
            "the controller went off the bus (bus-off) during the check",
            "it detected too many errors: a short, an open wire, or another bit rate than the nodes'",
            CABLE,
        )
    acks = facts.errors.get("ack", 0)
    if acks:
        yield problem(
            "nobody-acknowledges",
            f"{acks} error reports of frames that no controller acknowledged",
            "no other controller hears this one: it is alone, cut off, or all others run at another bit "
            "rate or have no power",
            "check power and plugs of the nodes, then the bit rate they were built for; " + CABLE,
        )
    damaged = sum(facts.errors.get(kind, 0) for kind in WIRE_ERRORS)
    if damaged:
        kinds = ", ".join(f"{facts.errors[kind]} {kind}" for kind in WIRE_ERRORS if facts.errors.get(kind))
        if facts.frames:
            yield warning(
                "damaged-frames",
                f"{damaged} error reports of damaged frames ({kinds}), and {facts.frames} good frames",
                "the signal is bad: a missing or surplus terminator, long stubs, a loose crimp, or power "
                "wires next to the bus",
                CABLE,
            )
        else:
            yield problem(
                "only-damage",
                f"{damaged} error reports of damaged frames ({kinds}) and not one good frame",
                "frames are sent, but none can be read: most often the bit rate of this interface "
                "is not theirs, or H and L are swapped",
                "set the bit rate that the nodes were built for, or let 'canductor can doctor"
                " --try-bitrates' find it",
            )


def _lost(facts: TrafficFacts, bus: BusOptions) -> Iterator[Finding]:
    if facts.send_queue_full:
        yield problem(
            "send-queue-full",
            "a handful of short frames did not fit into the send queue ('No buffer space available',"
            " ENOBUFS)",
            "the queue is very short, or full because no frame leaves it: none is acknowledged, or frames "
            "with higher priority occupy the bus",
            f"sudo ip link set {bus.name} txqueuelen 128; if it persists, list the traffic:"
            f" 'canductor can load {bus.arguments}'",
        )
    if facts.errors.get("overflow"):
        yield warning(
            "adapter-overflow",
            f"the adapter reported {facts.errors['overflow']} times that it had no room for a frame",
            "frames are lost in the adapter: the host fetches them too slowly",
            "connect the adapter to a USB port of its own, without a hub",
        )
    before, after = facts.before, facts.after
    if before is None or after is None:
        return
    lost = after.rx_dropped - before.rx_dropped + after.rx_overruns - before.rx_overruns
    if lost > 0:
        yield warning(
            "frames-dropped",
            f"{lost} received frames were dropped while the bus was watched (counters of {after.name})",
            "the kernel or the adapter had no room: programs saw less than the bus carried",
            "find a program that uses all processor time; sudo sysctl net.core.rmem_max=2097152 allows "
            "larger receive buffers",
        )
    errors = after.bus_errors - before.bus_errors
    if errors > 0 and not facts.error_reports:
        yield warning(
            "bus-errors",
            f"{errors} bus errors were counted while the bus was watched",
            "frames are damaged and sent again: it works and takes time, until it no longer does",
            CABLE,
        )


def _node(way: DirectionFacts, interface: InterfaceFacts | None) -> Iterator[Finding]:
    if way.invalid_bytes:
        yield warning(
            "bytes-invalid",
            f"{way.invalid_bytes} bytes from node {way.nodeid} made no valid block (hosts count this as"
            " bytes_invalid)",
            "frames arrive in another order than they were sent, or some are missing. Bad wiring does not do"
            f" that: controllers send damaged frames again. {_reorder_hint(interface)}",
            "update the kernel to 6.6 or newer and the adapter's firmware; and let only one host use the bus",
        )
    if way.to_blocks and way.repeated_blocks / way.to_blocks > REPEATS_MANY:
        yield warning(
            "bytes-retransmit",
            f"{way.repeated_blocks} of {way.to_blocks} blocks to node {way.nodeid} were sent more than "
            f"once, and {way.naks} were refused (hosts count this as bytes_retransmit)",
            "blocks or their acknowledgements get lost or come too late: an overloaded bus or host, or "
            "frames lost in the adapter",
            "see whether 'frames-dropped' or 'bus-overloaded' is reported here too; a few after a restart are"
            " normal",
        )
    if way.rtt_p99_s is not None and way.rtt_median_s is not None and way.rtt_p99_s > RTT_SPREAD_S:
        yield slow(way.nodeid, way.rtt_median_s, way.rtt_p99_s, "its host's traffic")


def slow(nodeid: int, median_s: float, p99_s: float, how: str) -> Finding:
    """Return the finding for a node with widely spread round trips."""
    return warning(
        "round-trip-spread",
        f"node {nodeid} answers in {median_s * 1000:.1f} ms as a rule, but one answer in a hundred takes"
        f" {p99_s * 1000:.1f} ms or more (measured by {how})",
        "commands sent shortly before they are due come too late, and the node's clock is known less well: "
        "a busy bus or host, a long send queue, or USB power saving",
        "compare under load and without: 'canductor can load'; turn power saving of the USB port off"
        " (echo on | sudo tee /sys/bus/usb/devices/*/power/control)",
    )


def _reorder_hint(interface: InterfaceFacts | None) -> str:
    if interface is None:
        return "Some adapters and kernels reorder."
    adapter = interface.adapter
    if adapter.usb_id == CANDLELIGHT_USB:
        return f"The adapter ({adapter.usb_name or 'gs_usb'}) may be one of those: {CANDLELIGHT_FAULT}."
    return f"Kernel {adapter.kernel}, driver {adapter.driver or 'unknown'}."

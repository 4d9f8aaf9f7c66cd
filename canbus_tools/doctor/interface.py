"""Checks of the interface."""

from collections.abc import Iterator
from typing import Final

from canbus_tools.bus.link_facts import DRIVER_CAN, DRIVER_VCAN, LinkFacts
from canbus_tools.doctor.facts import InterfaceFacts
from canbus_tools.doctor.finding import Finding, note, problem, warning
from canbus_tools.doctor.known_faults import faults_of

QUEUE_MIN: Final = 32
"""Frames. A host's burst to some nodes is as long; the kernel's default of 10 is too short for that."""
QUEUE_MAX: Final = 256
"""33 ms at 1 Mbit/s. What waits in the kernel can no longer be overtaken, by an emergency stop either."""
QUEUE_GOOD: Final = 128
VCAN_QUEUE: Final = 1000
"""What a vcan shows and does not have: it takes every frame at once."""
USUAL_BITRATES: Final = (1_000_000, 500_000, 250_000)
FRAME_BITS: Final = 130
"""A full frame on the wire."""
ERRORS_PASSIVE: Final = 128


def check_presence(facts: InterfaceFacts) -> Iterator[Finding]:
    """Check that the interface exists, is a CAN interface and is up, without which nothing else works."""
    name, link = facts.name, facts.link
    if link is None:
        there = ", ".join(facts.others)
        yield problem(
            "interface-missing",
            f"there is no network interface {name}; CAN interfaces here: {there or 'none'}",
            "the adapter is not plugged in, its driver is not loaded, or the interface has another name",
            f"use an existing one: 'canductor can doctor -c {facts.others[0]}'"
            if there
            else "plug the adapter in and check the kernel's messages: dmesg | grep -i can",
        )
    elif not link.kind:
        yield problem(
            "not-can",
            f"{name} is not a CAN interface",
            "this protocol cannot use it",
            f"use a CAN interface ({', '.join(facts.others) or 'there is none here'})",
        )
    elif not link.up:
        bitrate = "" if link.kind == DRIVER_VCAN else " type can bitrate 1000000 restart-ms 100"
        yield problem(
            "interface-down",
            f"{name} is down",
            "it neither sends nor receives; it was not set up since the machine started, or was taken down",
            f"sudo ip link set {name} up{bitrate}",
        )


def check_link(facts: InterfaceFacts) -> Iterator[Finding]:
    """Check the settings of the interface and the counters of its controller."""
    if facts.link is None or not facts.link.up:
        return
    yield from _queue(facts.link)
    if facts.link.kind == DRIVER_CAN:
        yield from _settings(facts.link)
        yield from _state(facts.link)
        yield from _history(facts.link)
    yield from _adapter(facts)


def _queue(link: LinkFacts) -> Iterator[Finding]:
    length = link.txqueuelen
    if length is None or (link.kind == DRIVER_VCAN and length == VCAN_QUEUE):
        return
    fix = f"sudo ip link set {link.name} txqueuelen {QUEUE_GOOD}"
    if length < QUEUE_MIN:
        yield warning(
            "txqueuelen-small",
            f"the send queue of {link.name} holds {length} frames (txqueuelen)",
            "a burst of frames does not fit: programs get 'No buffer space available' (ENOBUFS), and some "
            "lose the frame",
            fix,
        )
    elif length > QUEUE_MAX:
        bitrate = link.bitrate or USUAL_BITRATES[0]
        wait_ms = length * FRAME_BITS * 1000 / bitrate
        yield warning(
            "txqueuelen-large",
            f"the send queue of {link.name} holds {length} frames (txqueuelen)",
            f"on a busy bus a frame may wait {wait_ms:,.0f} ms behind others, an emergency stop too; a long "
            "queue hides a bus that is too slow until commands come too late",
            fix,
        )


def _settings(link: LinkFacts) -> Iterator[Finding]:
    if link.bitrate is not None and link.bitrate not in USUAL_BITRATES:
        yield note(
            "bitrate-unusual",
            f"{link.name} runs at {link.bitrate} bit/s",
            "boards are usually built for 1000000, 500000 or 250000; a node built for another one hears"
            " nothing",
            f"if it is not meant: {_reset(link.name, 1_000_000)}",
        )
    if link.restart_ms == 0:
        yield warning(
            "no-restart",
            f"restart-ms of {link.name} is 0",
            "when errors drive the controller off the bus (bus-off) it stays off until someone sets the"
            " interface down and up",
            _reset(link.name, link.bitrate),
        )
    if "LISTEN-ONLY" in link.modes:
        yield problem(
            "listen-only",
            f"{link.name} is set to listen only",
            "it neither sends nor acknowledges: no node hears it",
            f"sudo ip link set {link.name} down; sudo ip link set {link.name} up type can listen-only off",
        )
    if "ONE-SHOT" in link.modes:
        yield warning(
            "one-shot",
            f"{link.name} is set to one-shot",
            "a frame that loses arbitration or meets an error is dropped, not sent again",
            f"sudo ip link set {link.name} down; sudo ip link set {link.name} up type can one-shot off",
        )


def _state(link: LinkFacts) -> Iterator[Finding]:
    tx, rx = link.tx_errors or 0, link.rx_errors or 0
    counters = f"error counters: {tx} sending, {rx} receiving"
    if link.state == "BUS-OFF":
        yield problem(
            "bus-off",
            f"the controller of {link.name} is bus-off ({counters})",
            "it met so many errors that it took itself off the bus: a short or open wire, no termination, or"
            " another bit rate than the nodes'",
            "check the cable, then " + _reset(link.name, link.bitrate),
        )
    elif link.state == "ERROR-PASSIVE" or max(tx, rx) >= ERRORS_PASSIVE:
        yield problem(
            "error-passive",
            f"the controller of {link.name} is error-passive ({counters})",
            _cause(tx, rx),
            CABLE,
        )
    elif link.state == "ERROR-WARNING":
        yield warning(
            "error-warning",
            f"the controller of {link.name} has met many errors ({counters})",
            _cause(tx, rx),
            CABLE,
        )


CABLE: Final = (
    "switch all off, measure between CANH and CANL: 60 ohm is right, 120 ohm says that one terminator is"
    " missing,"
    " 40 or less that there is one too many; then check that H and L are not swapped, and the bit rates"
)


def _cause(tx: int, rx: int) -> str:
    if tx > rx:
        return (
            "its frames are not acknowledged: no other node is on the bus, or all others run at another bit "
            "rate, have no power or are cut off"
        )
    return (
        "it hears frames that are damaged: a missing or surplus terminator, swapped wires, a loose crimp, or "
        "nodes at another bit rate"
    )


def _history(link: LinkFacts) -> Iterator[Finding]:
    if link.bus_offs and link.state != "BUS-OFF":
        yield warning(
            "was-bus-off",
            f"{link.name} was bus-off {link.bus_offs} times since it was set up",
            "the wiring fails now and then; a print that runs at such a moment fails",
            CABLE,
        )
    if link.rx_overruns:
        yield warning(
            "adapter-overruns",
            f"the adapter of {link.name} had no room for {link.rx_overruns} frames it received (overruns)",
            "frames are lost in the adapter or its driver: the host is too slow in fetching them, often a "
            "busy USB hub or SPI",
            "connect the adapter to a port of its own; 'ip -s link show "
            + link.name
            + "' shows whether it grows",
        )


def _adapter(facts: InterfaceFacts) -> Iterator[Finding]:
    adapter = facts.adapter
    for fault in faults_of(adapter.driver, adapter.kernel):
        fixed = ".".join(map(str, fault.fixed_in))
        yield warning(
            "kernel-reorders",
            f"{facts.name} is driven by {fault.driver} of kernel {adapter.kernel}",
            f"before {fixed} that driver {fault.what}; blocks arrive in pieces, hosts count bytes_invalid "
            f"and time out ({fault.source})",
            f"update the kernel to {fixed} or newer (uname -r; sudo apt full-upgrade), or use a "
            "distribution that took the change over",
        )


def _reset(name: str, bitrate: int | None) -> str:
    return (
        f"sudo ip link set {name} down; sudo ip link set {name} up type can bitrate {bitrate or 1_000_000}"
        " restart-ms 100"
    )

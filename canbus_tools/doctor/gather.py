"""Gathers the facts for the doctor: from the kernel, by listening, and by queries."""

import asyncio
import errno
import os
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import can

from canbus_tools.bus.bus_load import BusLoad, LoadMeter
from canbus_tools.bus.computer import Computer, now_s
from canbus_tools.bus.link_facts import LinkFacts, NoInterface, read_link
from canbus_tools.bus.open_bus import BusOptions, open_bus
from canbus_tools.bus.talk import BusTalk
from canbus_tools.discovery.inventory import Inventory, NodePresence, take_inventory
from canbus_tools.doctor.facts import (
    AdapterFacts,
    DirectionFacts,
    InterfaceFacts,
    NodeFacts,
    PingFacts,
    TrafficFacts,
)
from canbus_tools.protocol.decoder import BusDecoder
from canbus_tools.protocol.flow import RoundTrips
from canbus_tools.protocol.frame import Frame, FrameKind
from nodes.link import LinkStats
from nodes.support.can_protocol import ADMIN_ID, ADMIN_RESPONSE_ID
from nodes.support.errors import CanductorError

ASKED: Final = 100
"""Queries to each node."""
PING_S_MAX: Final = 5.0
"""Longest time for one node; on a bus that loses many frames every query takes long."""
LATE_S: Final = 0.2
"""Time for late answers to the last queries."""
TRIED_BITRATES: Final = (1_000_000, 500_000, 250_000, 125_000)
_SYS_NET: Final = Path("/sys/class/net")
_ARPHRD_CAN: Final = "280"
_BURST: Final = 16
NO_COMMAND: Final = 0xFF
"""An admin command that does not exist: nodes ignore it, so no late answer disturbs the next query."""
_QUESTIONS: Final = (("get_uptime", "uptime"), ("get_clock", "clock"), ("get_config", "config"))


# -------------------------------------------------------------------------------------------------- interface


def read_interface(name: str, folder: Path = _SYS_NET) -> InterfaceFacts:
    """Read the facts of a SocketCAN interface; raises CanductorError if ip cannot be used."""
    others = tuple(sorted(path.name for path in folder.glob("*") if _text(path / "type") == _ARPHRD_CAN))
    try:
        link = read_link(name)
    except NoInterface:
        return InterfaceFacts(name=name, link=None, others=others)
    return InterfaceFacts(name=name, link=link, others=others, adapter=read_adapter(folder / name, link))


def read_adapter(interface: Path, link: LinkFacts | None = None) -> AdapterFacts:
    """Read the driver and adapter of an interface from its folder below /sys."""
    device = interface / "device"
    driver = (device / "driver").resolve().name if (device / "driver").exists() else ""
    usb = device.resolve().parent if device.exists() else device
    vendor, product = _text(usb / "idVendor"), _text(usb / "idProduct")
    usb_id = (int(vendor, 16), int(product, 16)) if vendor and product else None
    return AdapterFacts(
        kernel=os.uname().release,
        driver=driver or (link.driver if link is not None else ""),
        usb_id=usb_id,
        usb_name=_text(usb / "product"),
    )


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


# -------------------------------------------------------------------------------------------------- listening


class BusListener:
    """Listens on a bus, opened for itself, during ``wait``; ``facts`` returns the result."""

    def __init__(self, computer: Computer, options: BusOptions, bitrate: int | None) -> None:
        self._computer = computer
        self._opened = computer.listen(options)
        self._meter = None if bitrate is None else LoadMeter(bitrate)
        self._decoder = BusDecoder()
        self._frames = 0
        self._calm: tuple[BusLoad | None, int, tuple[DirectionFacts, ...]] | None = None
        self._errors: Counter[str] = Counter()
        self._started_s = self._ended_s = 0.0

    def __enter__(self) -> Self:
        self._bus = self._opened.__enter__()
        self._started_s = now_s(self._computer)
        if self._meter is not None:
            self._meter.begin(self._started_s)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self._take(self._bus.take())
        finally:
            self._opened.__exit__(kind, error, trace)

    def wait(self, seconds: float) -> None:
        """Listen for SECONDS; raises CanductorError when the bus ends."""
        end_s = now_s(self._computer) + seconds
        while (left_s := end_s - now_s(self._computer)) > 0:
            self._take(self._bus.take(left_s))

    def start_of_queries(self) -> None:
        """Receive only answers and error reports from now on, as this program starts to send.

        Where the kernel filters, other frames are not even read, which would slow down the queries.
        """
        self._bus.only(ADMIN_RESPONSE_ID)
        self._calm = self._figures()

    def _figures(self) -> tuple[BusLoad | None, int, tuple[DirectionFacts, ...]]:
        self._ended_s = now_s(self._computer)
        if self._meter is not None:
            self._meter.advance(self._ended_s)
        load = None if self._meter is None else self._meter.load()
        return load, self._decoder.other_frames, tuple(self._ways())

    def _take(self, frames: Iterable[Frame]) -> None:
        for frame in frames:
            if self._meter is not None:
                # Times of this clock: some backends use others.
                self._meter.feed(frame._replace(time_s=now_s(self._computer)))
            self._count(frame)

    def _count(self, frame: Frame) -> None:
        if frame.kind is FrameKind.ERROR:
            self._errors.update(error_kinds(frame))
        else:
            self._frames += 1
        self._decoder.feed(frame)

    def facts(
        self, before: LinkFacts | None = None, after: LinkFacts | None = None, *, queue_full: bool = False
    ) -> TrafficFacts:
        """Return the traffic before the queries, and the error reports until ``with`` ended."""
        load, other_frames, ways = self._calm or self._figures()
        return TrafficFacts(
            listened_s=self._ended_s - self._started_s,
            load=load,
            frames=self._frames,
            other_frames=other_frames,
            error_reports=self._decoder.error_frames,
            errors=dict(self._errors),
            nodes=ways,
            send_queue_full=queue_full,
            before=before,
            after=after,
        )

    def _ways(self) -> list[DirectionFacts]:
        found = []
        for nodeid, node in sorted(self._decoder.nodes.items()):
            trips = node.flow.round_trips
            found.append(
                DirectionFacts(
                    nodeid=nodeid,
                    to_blocks=node.to_node.blocks,
                    # A single stretch may be the end of a block that began before this listener.
                    invalid_bytes=node.from_node.invalid_bytes if node.from_node.noises > 1 else 0,
                    repeated_blocks=node.flow.repeated_blocks,
                    naks=node.flow.naks,
                    rtt_median_s=trips.quantile_s(0.5) if trips.count else None,
                    rtt_p99_s=trips.quantile_s(0.99) if trips.count else None,
                )
            )
        return found


def error_kinds(frame: Frame) -> set[str]:
    """Return the kinds of errors that an error frame (linux/can/error.h) reports."""
    kinds = set()
    data = frame.data.ljust(8, b"\0")
    if frame.can_id & 0x020:
        kinds.add("ack")
    if frame.can_id & 0x040:
        kinds.add("bus off")
    if frame.can_id & 0x008:
        kinds |= {name for bit, name in ((0x02, "form"), (0x04, "stuff"), (0x19, "bit")) if data[2] & bit}
    if frame.can_id & 0x004 and data[1] & 0x03:
        kinds.add("overflow")
    return kinds or {"other"}


def fill_queue(options: BusOptions) -> bool:
    """Return whether a burst of short frames overflows the send queue; raises CanductorError."""
    bus = open_bus(options)
    nothing = can.Message(arbitration_id=ADMIN_ID, data=bytes([NO_COMMAND]), is_extended_id=False)
    try:
        for _ in range(_BURST):
            bus.send(nothing)
    except can.CanOperationError as error:
        if error.error_code == errno.ENOBUFS:
            return True
        raise CanductorError(f"CAN bus {options.name}: sending failed: {error}") from error
    finally:
        bus.shutdown()
    return False


# ----------------------------------------------------------------------------------------------------- asking


async def query_nodes(bus: BusTalk) -> NodeFacts:
    """Find all nodes, and query those that no other host uses; raises CanductorError."""
    found = await take_inventory(bus)
    pings: list[PingFacts] = []
    silenced: dict[int, str] = {}
    for nodeid in _available(found):
        try:
            pings.append(await _ping(bus, nodeid))
        except CanductorError as error:
            if bus.closed_because is not None:
                raise
            silenced[nodeid] = str(error)
    return NodeFacts(inventory=found, pings=tuple(pings), silenced=silenced)


def _available(found: Inventory) -> list[int]:
    calm = (NodePresence.IDLE, NodePresence.CONFIGURED, NodePresence.SHUTDOWN)
    return [entry.nodeid for entry in found.entries if entry.nodeid is not None and entry.state in calm]


async def _ping(bus: BusTalk, nodeid: int) -> PingFacts:
    async with bus.node(nodeid) as talk:
        # The download of the dictionary is not part of the measurement.
        before = talk.stats
        question = next((words for words in _QUESTIONS if talk.knows(*words)), _QUESTIONS[0])
        trips = RoundTrips()
        loop = asyncio.get_running_loop()
        end_s = loop.time() + PING_S_MAX
        while trips.count < ASKED and loop.time() < end_s:
            asked_s = loop.time()
            await talk.ask(*question)
            trips.add(loop.time() - asked_s)
        if _lost(before, talk.stats):
            await bus.wait(LATE_S)
        stats = talk.stats
    return PingFacts(
        nodeid=nodeid,
        lost=_lost(before, stats),
        asked=trips.count,
        repeats=stats.blocks_repeated - before.blocks_repeated,
        invalid_bytes=stats.bytes_invalid - before.bytes_invalid,
        rtt_median_s=trips.quantile_s(0.5),
        rtt_p99_s=trips.quantile_s(0.99),
    )


def _lost(before: LinkStats, after: LinkStats) -> int:
    """Return the time-outs to which no late answer came."""
    late = after.acks_duplicate - before.acks_duplicate + after.naks - before.naks
    return max(0, after.timeouts - before.timeouts - late)


def try_bitrates(computer: Computer, options: BusOptions, listen_s: float) -> dict[int, int]:
    """Listen at each candidate without disturbing the bus; return the good frames heard. CanductorError."""
    heard = {}
    for bitrate in TRIED_BITRATES:
        other = BusOptions(
            interface=options.interface, channel=options.channel, bitrate=bitrate, listen_only=True
        )
        with BusListener(computer, other, None) as listener:
            listener.wait(listen_s)
        heard[bitrate] = listener.facts().frames
    return heard

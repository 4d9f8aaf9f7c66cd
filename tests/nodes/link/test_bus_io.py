"""What LinkIO takes, refuses and hands over, on a bus by hand; and the thread that it starts by default."""

import asyncio
import os
import resource
import selectors
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import pytest

from nodes.link import BusSettings, IOStats, LinkError, LinkIO, LinkSettings, Response, TransportKind
from nodes.link._link import ffi, lib
from nodes.link.thread_driver import ThreadDriver
from tests.nodes.link.by_hand import START_NS, ByHand
from tests.nodes.link.peers import FRAME, TIMEOUT_S, Inbox, SocketTransport, open_files, pack_frame
from tests.nodes.link.twin import ask
from tests.wire_twin import block

RESPONSE_ID = 0x101 + 2 * 4
"""From node 4."""
BATCH = 128
"""Events that are handled in one turn of the loop."""
MANY = 3000
"""Responses that wait: more than half of their ring."""
ENDLESS = 100


class Bus:
    """A LinkIO on a bus by hand."""

    def __init__(self, driver: ByHand | None = None, **options: Any) -> None:
        self.driver = driver or ByHand(serial=False)
        self.inbox = Inbox()
        self.io = LinkIO.driven_by(self.driver, **options)

    def open(self, settings: LinkSettings, **handlers: Any) -> Any:
        inbox = self.inbox
        return self.io.open_link(
            settings, **{"on_responses": inbox.on_responses, "on_lost": inbox.on_lost, **handlers}
        )

    def responses_come(self, count: int = 1, can_id: int = RESPONSE_ID) -> None:
        for i in range(count):
            data = block(0, bytes([i % 251]))
            self.driver.receive(pack_frame(can_id, data))

    def frames_come(self, count: int) -> None:
        for i in range(count):
            self.driver.receive(pack_frame(0x3F1, i.to_bytes(2)))


# ---------------------------------------------------------------------------------------------- opening links


@pytest.mark.parametrize("nodeid", [1, 255])
def test_node_ids_and_limits_at_the_edges_are_taken(nodeid: int) -> None:
    bus = Bus()
    settings = LinkSettings(nodeid, receive_window=64, lost_after_s=0.001)
    assert bus.open(settings).name == f"by hand node {nodeid}"
    assert (
        Bus(ByHand(serial=True)).open(LinkSettings(None, lost_after_s=3600, ahead_s=3600)).name == "by hand"
    )
    with pytest.raises(LinkError, match=f"node {nodeid}: there is a link with this id already, or 128 links"):
        bus.open(settings)


@pytest.mark.parametrize(
    ("serial", "settings", "words"),
    [
        (
            False,
            LinkSettings(None),
            "node None: a link needs a node id of 1..255 on CAN and none on a serial",
        ),
        (False, LinkSettings(0), "node 0: a link needs a node id"),
        (False, LinkSettings(-1), "node -1: a link needs a node id"),
        (False, LinkSettings(256), "node 256: a link needs a node id"),
        (True, LinkSettings(4), "node 4: a link needs a node id"),
        (True, LinkSettings(0), "node 0: a link needs a node id"),
        (
            False,
            LinkSettings(4, receive_window=63),
            "window of 63 bytes cannot hold a block; 64 is the least",
        ),
        (False, LinkSettings(4, lost_after_s=0.0009), "lost_after_s=0.0009 is not within 0.001..3600 s"),
        (False, LinkSettings(4, lost_after_s=3600.5), "lost_after_s=3600.5 is not within 0.001..3600 s"),
        (False, LinkSettings(4, ahead_s=-0.1), "ahead_s=-0.1 is not within 0..3600 s"),
        (False, LinkSettings(4, ahead_s=3600.5), "ahead_s=3600.5 is not within 0..3600 s"),
    ],
)
def test_settings_that_cannot_be_are_refused_in_words(
    serial: bool, settings: LinkSettings, words: str
) -> None:
    bus = Bus(ByHand(serial=serial))
    with pytest.raises(LinkError, match=words):
        bus.open(settings)
    bus.io.close()


def test_a_link_is_lost_after_the_time_that_was_set_to_the_nanosecond() -> None:
    bus = Bus()
    bus.open(LinkSettings(4, lost_after_s=3600)).send(ask(1))
    out = ffi.new("uint8_t[]", lib.IO_OUT_FRAMES * FRAME.size)
    driver = bus.driver
    while not driver.noticed:
        while lib.io_next(driver.bus, driver.now, 0, out, len(out)):
            pass
        driver.now = lib.io_deadline(driver.bus, driver.now)
        lib.io_handle_time(driver.bus, driver.now)
    assert driver.now == START_NS + 3600 * 10**9
    driver.hand_over()
    assert len(bus.inbox.lost) == 1


def test_an_ended_transport_takes_no_link_and_no_frame() -> None:
    bus = Bus()
    lib.io_end(bus.driver.bus, 0)
    with pytest.raises(LinkError, match="the connection ended"):
        bus.open(LinkSettings(4))
    with pytest.raises(LinkError, match="the connection ended"):
        bus.io.send_frame(0x3F0, b"")


def test_frames_that_cannot_go_are_refused_in_words() -> None:
    bus = Bus()
    with pytest.raises(LinkError, match=r"a frame of 9 bytes; CAN frames have 0\.\.8, serial lines none"):
        bus.io.send_frame(0x3F0, bytes(9))
    for _ in range(256):
        bus.io.send_frame(0x3F0, bytes(8))
    with pytest.raises(LinkError, match="256 admin frames wait already"):
        bus.io.send_frame(0x3F0, bytes(8))
    with pytest.raises(LinkError, match="serial lines none"):
        Bus(ByHand(serial=True)).io.send_frame(0x3F0, b"")


def test_a_bit_rate_is_learned_once() -> None:
    bus = Bus()
    for bitrate, known in ((0, 0), (250_000, 250_000), (500_000, 250_000)):
        bus.io.learn_bitrate(bitrate)
        bus.driver.receive(b"")
        assert bus.io.stats().bitrate == known
    bus = Bus(ByHand(serial=False, bitrate=1_000_000))
    bus.driver.receive(b"")
    bus.io.learn_bitrate(500_000)
    bus.driver.receive(b"")
    assert bus.io.stats().bitrate == 1_000_000


# --------------------------------------------------------------------------------------------- handing over


def test_what_comes_at_once_is_handed_over_in_turns_of_the_loop() -> None:
    async def test() -> None:
        bus = Bus()
        bus.inbox = inbox = Inbox()
        bus.io = LinkIO.driven_by(bus.driver, on_frame=inbox.on_frame, on_closed=inbox.on_closed)
        bus.open(LinkSettings(4))
        bus.responses_come(700)
        bus.frames_come(600)
        lib.io_end(bus.driver.bus, 0)
        bus.driver.hand_over()
        turns, before = 1, 0
        while now := len(inbox.responses) + len(inbox.frames) - before:
            assert now <= BATCH
            before += now
            turns += 1
            await asyncio.sleep(0)
        assert turns - 1 == -(-1301 // BATCH)
        assert [response.content[0] for response in inbox.responses] == [i % 251 for i in range(700)]
        assert [int.from_bytes(frame.data) for frame in inbox.frames] == list(range(600))
        assert {(f.can_id, f.received_ns) for f in inbox.frames} == {(0x3F1, START_NS)}
        assert len(inbox.closed) == 1

    asyncio.run(test())


def test_a_flood_holds_the_loop_for_a_batch_in_each_turn() -> None:
    """Failed before: what came while a batch was handled was handled at once, too, without end."""

    async def test() -> None:
        seen: list[int] = []
        ended: list[str] = []

        def flood(responses: list[Response]) -> None:
            seen.append(len(responses))
            assert len(seen) < ENDLESS
            bus.responses_come(len(responses))

        bus = Bus(on_closed=ended.append)
        link = bus.open(LinkSettings(4), on_responses=flood)
        bus.responses_come(MANY)
        bus.driver.hand_over()
        for turn in range(1, 4):
            bus.driver.hand_over()  # the descriptor is readable again in each turn
            assert seen == [BATCH] * turn
            await asyncio.sleep(0)
        link.take()
        assert len(seen) == 5, "who asks gets a batch at once"
        lib.io_end(bus.driver.bus, 0)
        await asyncio.sleep(0)
        assert len(ended) == 1, "and a notice does not wait for the end of the flood"
        bus.io.close()
        await asyncio.sleep(0)
        assert len(seen) == 6

    asyncio.run(test())


def test_frames_go_before_all_responses() -> None:
    """The frame with which a node stops its bus has the reason."""

    async def test() -> None:
        seen: list[str] = []
        bus = Bus(on_frame=lambda _: seen.append("frame"))
        bus.open(LinkSettings(4), on_responses=lambda _: seen.append("responses"))
        bus.responses_come(2 * BATCH)
        bus.frames_come(1)
        bus.driver.hand_over()
        assert seen == ["frame", "responses"]

    asyncio.run(test())


def test_nobody_has_to_listen() -> None:
    bus = Bus()
    bus.frames_come(1)
    lib.io_end(bus.driver.bus, 0)
    bus.driver.hand_over()


def test_a_bus_that_a_handler_closes_hands_nothing_more_over() -> None:
    inbox = Inbox()

    def close(frame: Any) -> None:
        inbox.on_frame(frame)
        bus.io.close()

    async def close_amid_frames() -> None:
        bus.frames_come(600)
        bus.driver.hand_over()
        await asyncio.sleep(0)
        assert len(inbox.frames) == 1

    bus = Bus(on_frame=close)
    asyncio.run(close_amid_frames())

    bus = Bus(on_closed=inbox.on_closed)
    bus.open(LinkSettings(4), on_responses=lambda _: bus.io.close())
    bus.responses_come()
    lib.io_end(bus.driver.bus, 0)
    bus.driver.hand_over()
    assert inbox.closed == []
    assert bus.driver.closed == 1


def test_a_link_that_a_handler_closes_gets_nothing_more() -> None:
    bus, seen = Bus(), []
    links: list[Any] = []

    def close_other(at: int) -> Any:
        def handle(responses: list[Response]) -> None:
            seen.append((at, len(responses)))
            links[1 - at].close()

        return handle

    links += [bus.open(LinkSettings(4 + at), on_responses=close_other(at)) for at in range(2)]
    bus.responses_come(3)
    bus.responses_come(1, RESPONSE_ID + 2)
    bus.driver.hand_over()
    assert seen == [(0, 3)]


def test_a_handler_that_fails_keeps_no_other_from_what_is_for_it() -> None:
    """Failed before: the rest of the batch was gone, and notices, which come once."""

    def fail(*_: object) -> None:
        raise ZeroDivisionError

    async def test() -> None:
        bugs: list[str] = []
        asyncio.get_running_loop().set_exception_handler(lambda _, context: bugs.append(context["message"]))
        ended: list[str] = []
        bus = Bus(on_frame=fail, on_closed=ended.append)
        bus.open(LinkSettings(4), on_responses=fail)
        good = bus.open(LinkSettings(5))
        good.send(ask(1))
        waiter = asyncio.ensure_future(good.drained())
        await asyncio.sleep(0)
        bus.frames_come(2)
        bus.responses_come(1)
        bus.responses_come(3, RESPONSE_ID + 2)
        lib.io_end(bus.driver.bus, 0)
        bus.driver.hand_over()
        assert len(bus.inbox.responses) == 3
        assert len(ended) == 1
        with pytest.raises(LinkError, match="the connection ended"):
            await waiter
        assert bugs == [
            f"{what} could not be handled; this is reported once"
            for what in ("by hand: a frame", "by hand: responses")
        ]

    asyncio.run(test())


def test_a_notice_that_cannot_be_handled_keeps_no_other_from_being_handled() -> None:
    async def test() -> None:
        bugs: list[str] = []
        asyncio.get_running_loop().set_exception_handler(lambda _, context: bugs.append(context["message"]))

        def fail(_: str) -> None:
            raise ZeroDivisionError

        lost: list[str] = []
        bus = Bus()
        links = [
            bus.open(LinkSettings(4 + at), on_lost=on_lost) for at, on_lost in enumerate((fail, lost.append))
        ]
        for link in links:
            link.send(ask(1))
        out = ffi.new("uint8_t[]", lib.IO_OUT_FRAMES * FRAME.size)
        driver = bus.driver
        for _ in range(ENDLESS):
            while lib.io_next(driver.bus, driver.now, 0, out, len(out)):
                pass
            driver.now += 50_000_000
            lib.io_handle_time(driver.bus, driver.now)
        driver.hand_over()
        assert len(lost) == 1
        assert bugs == ["by hand: a notice could not be handled; this is reported once"]

    asyncio.run(test())


def test_who_waits_for_a_drained_link_is_told_when_the_transport_ends() -> None:
    async def test() -> None:
        bus = Bus()
        link = bus.open(LinkSettings(4))
        link.send(ask(1))
        waiter = asyncio.ensure_future(link.drained())
        await asyncio.sleep(0)
        lib.io_end(bus.driver.bus, 0)
        bus.driver.hand_over()
        with pytest.raises(LinkError, match="the connection ended"):
            await waiter

    asyncio.run(test())


def test_the_last_counters_stay_after_the_end() -> None:
    bus = Bus(ByHand(serial=False, bitrate=1_000_000))
    link = bus.open(LinkSettings(4))
    bus.responses_come(2)
    bus.io.close()
    bus.io.close()
    assert bus.driver.closed == 1
    assert bus.io.stats().frames_received == 2
    assert bus.io.load().data == bus.io.stats().load.data > 0
    assert link.stats().received.frames == 2
    with pytest.raises(LinkError, match="closed by this program"):
        bus.io.forecast()


# --------------------------------------------------------------------------------------------------- figures


class ToldStats:
    """The C library, but for the counters, each of which gets a value of its own."""

    def __init__(self, bitrate: int) -> None:
        self.bitrate = bitrate
        self.values: dict[str, int] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(lib, name)

    def io_get_stats(self, _: Any, out: Any) -> None:
        for number, (name, kind) in enumerate(ffi.typeof("struct io_stats").fields):
            if kind.type.kind == "array":
                for at in range(kind.type.length):
                    getattr(out, name)[at] = 1000 * number + at
            else:
                setattr(out, name, 1000 * number)
                self.values[name] = 1000 * number
        out.bitrate = self.values["bitrate"] = self.bitrate
        self.first = {name: 1000 * i for i, (name, _) in enumerate(ffi.typeof("struct io_stats").fields)}


@pytest.mark.parametrize("bitrate", [0, 500_000])
def test_every_counter_has_its_name(bitrate: int) -> None:
    told = ToldStats(bitrate)
    driver = ByHand(serial=False)
    driver.lib = told
    io = LinkIO.driven_by(driver)
    stats, rate = io.stats(), bitrate or 1
    recent, sent = told.first["recent_bits"], told.first["sent_bits"]
    assert (stats.motion_bits, stats.control_bits, stats.bulk_bits) == (sent, sent + 1, sent + 2)
    load = stats.load
    assert io.load() == load
    assert (load.motion, load.control, load.bulk) == tuple((recent + at) / rate for at in range(3))
    assert (load.acks, load.data, load.weak) == tuple((recent + at) / rate for at in range(3, 6))
    assert stats.held_s == pytest.approx(told.values["held_ns"] / 1e9, rel=1e-9)
    for field in fields(IOStats):
        if field.name in told.values:
            assert getattr(stats, field.name) == told.values[field.name]


def test_a_forecast_without_motion_knows_of_nothing_late() -> None:
    bus = Bus(ByHand(serial=False, bitrate=1_000_000))
    forecast = bus.io.forecast()
    assert forecast.now_ns == START_NS
    assert forecast.late_ns is None
    assert forecast.queued_bits == 0
    assert forecast.motion_bits_per_s == 900_000


# ------------------------------------------------------------------------------------------------- the thread


@dataclass
class CanTransport(SocketTransport):
    """A transport that may know its bit rate."""

    bitrate: int | None = None


@contextmanager
def transport(kind: TransportKind, bitrate: int | None = None) -> Iterator[CanTransport]:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        yield CanTransport("pair", kind, ours, bitrate)


def first_bitrate(line: SocketTransport, settings: BusSettings | None = None) -> int:
    """Return the bit rate that a LinkIO of LINE goes by."""
    loop = asyncio.new_event_loop()
    try:
        io = LinkIO(line, loop, settings=settings)
        link = io.open_link(
            LinkSettings(None if line.kind == TransportKind.BYTES else 4),
            on_responses=lambda _: None,
            on_lost=lambda _: None,
        )
        link.close()  # publishes
        bitrate = io.stats().bitrate
        io.close()
    finally:
        loop.close()
    return bitrate


def test_a_can_transports_bit_rate_counts_unless_settings_say_otherwise() -> None:
    with transport(TransportKind.CAN_STREAM, 250_000) as line:
        assert first_bitrate(line) == 250_000
        assert first_bitrate(line, BusSettings(125_000)) == 125_000
        assert first_bitrate(SocketTransport("pair", TransportKind.CAN_STREAM, line.socket)) == 0
    with transport(TransportKind.CAN_STREAM) as line:
        assert first_bitrate(line) == 0
    with transport(TransportKind.BYTES, 250_000) as line:
        assert first_bitrate(line) == 0


def test_a_thread_leaves_the_loop_and_the_descriptors_as_they_were() -> None:
    selector = selectors.SelectSelector()
    loop = asyncio.SelectorEventLoop(selector)
    try:
        watched, files, threads = list(selector.get_map()), open_files(), _threads()
        with transport(TransportKind.CAN_STREAM) as line:
            line.socket.setblocking(True)
            driver = ThreadDriver(line, loop, BusSettings())
            assert not os.get_blocking(line.fileno())
            assert driver.name == "pair"
            assert not driver.serial
            driver.listen(lambda: None)
            assert len(selector.get_map()) == len(watched) + 1
            (started,) = _threads() - threads
            driver.close()
        assert list(selector.get_map()) == watched
        assert open_files() == files
        end_s = time.monotonic() + TIMEOUT_S
        while started in _threads():  # one that was joined leaves the kernel's list a moment later
            assert time.monotonic() < end_s
            time.sleep(0.001)
    finally:
        loop.close()


def _threads() -> set[str]:
    return {task.name for task in Path("/proc/self/task").iterdir()}


def test_a_thread_that_cannot_start_is_told_in_words() -> None:
    loop = asyncio.new_event_loop()
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        with transport(TransportKind.BYTES) as line:
            free = os.dup(line.fileno())
            os.close(free)
            resource.setrlimit(resource.RLIMIT_NOFILE, (free, limits[1]))
            try:
                with pytest.raises(LinkError, match="pair: cannot start the I/O thread"):
                    ThreadDriver(line, loop, BusSettings())
            finally:
                resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    finally:
        loop.close()

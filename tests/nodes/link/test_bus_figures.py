"""What LinkIO tells of a bus whose bit rate it knows, over the real thread; and whose driver is another's."""

import asyncio
import socket
import struct
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from nodes.link import BusSettings, LinkError, LinkIO, LinkSettings, TransportKind
from nodes.link._link import ffi, lib
from tests.nodes.link.peers import TIMEOUT_S, Inbox, Peer, SocketTransport
from tests.nodes.link.twin import NodeTwin, ask, store

BITRATE = 1_000_000


def run(test: Coroutine[object, object, None]) -> None:
    async def limited() -> None:
        async with asyncio.timeout(2 * TIMEOUT_S):
            await test

    asyncio.run(limited())


def record(command: bytes, req_clock: int) -> bytes:
    return struct.pack("=QQB", 0, req_clock, len(command)) + command


def test_a_known_bit_rate_gives_figures_and_forecasts() -> None:
    async def test() -> None:
        ours, theirs = socket.socketpair()
        transport = SocketTransport("pair", TransportKind.CAN_STREAM, ours)
        node, inbox, loop = NodeTwin(), Inbox(), asyncio.get_running_loop()
        peer = Peer(TransportKind.CAN_STREAM, theirs, {4: node})
        io = LinkIO(transport, loop, settings=BusSettings(BITRATE))
        link = io.open_link(LinkSettings(4), on_responses=inbox.on_responses, on_lost=inbox.on_lost)
        now_ns = int(loop.time() * 1e9)
        link.set_clock(1e9, now_ns, now_ns)
        commands = [store(i, 8) for i in range(300)]
        link.send(store(1000, 40), bulk=True)
        link.send(ask(1))
        # 12 bytes each at 18.3 bits, 300 of them within 40 ms: 1.6 Mbit/s
        in_time = [record(c, now_ns + 2_000_000_000 + i * 133_000) for i, c in enumerate(commands)]
        link.send_batch(b"".join(in_time))
        await link.drained()
        await inbox.until(lambda: inbox.responses)
        assert [c for c in node.executed if len(c) < 20 and c[0] == 1] == commands
        stats, bus = link.stats(), io.stats()
        assert bus.bitrate == BITRATE
        assert (stats.motion.bits, stats.bulk.bits) == (bus.motion_bits, bus.bulk_bits)
        assert stats.control.bits == bus.control_bits
        assert bus.motion_bits > 300 * 12 * 14
        assert stats.bulk.blocks + stats.control.blocks + stats.motion.blocks == stats.blocks_sent
        assert 0 < bus.load.motion < bus.load.total
        assert 0 < bus.queued_max <= bus.queue_frames == 12
        quiet = io.forecast()
        assert (quiet.worst_ratio, quiet.late_ns, quiet.warning_s) == (0.0, None, None)
        peer.deafen()
        due_ns = loop_ns(loop) + 2_000_000_000
        too_much = [record(c, due_ns + i) for i, c in enumerate(commands * 100)]
        link.send_batch(b"".join(too_much))
        forecast = io.forecast()
        assert forecast.worst_ratio > 1
        assert forecast.late_ns is not None
        assert 0 <= forecast.late_ns - due_ns < len(too_much)
        assert forecast.warning_s == (forecast.late_ns - forecast.now_ns) * 1e-9
        assert 0.8 * BITRATE < forecast.motion_bits_per_s <= 0.9 * BITRATE
        io.close()
        with pytest.raises(LinkError, match="closed by this program"):
            io.forecast()
        transport.close()
        peer.close()

    run(test())


def loop_ns(loop: asyncio.AbstractEventLoop) -> int:
    return int(loop.time() * 1e9)


class ByHand:
    """A driver that moves nothing by itself."""

    name = "by hand"
    serial = True
    ffi = ffi
    lib = lib

    def __init__(self) -> None:
        self.now = 1_000_000_000
        self.noticed = self.closed = 0
        self.handler: Callable[[], None] | None = None
        self._callbacks = (
            ffi.callback("uint64_t(void *)", lambda _: self.now),
            ffi.callback("void(void *)", lambda _: None),
            ffi.callback("void(void *)", self._note),
        )
        now, nothing, note = self._callbacks
        driver = ffi.new("struct io_driver *", [now, nothing, nothing, nothing, note, ffi.NULL])
        self.bus: Any = lib.io_new(lib.IO_BYTES, ffi.new("struct io_settings *"), driver, ffi.NULL)

    def _note(self, _: object) -> None:
        self.noticed += 1

    def listen(self, handler: Callable[[], None]) -> None:
        self.handler = handler

    def close(self) -> None:
        self.closed += 1
        lib.io_free(self.bus)

    def exchange(self, node: NodeTwin) -> None:
        """Let host and node talk until both are silent."""
        out = ffi.new("uint8_t[]", lib.IO_OUT_FRAMES * 16)
        while size := lib.io_next(self.bus, self.now, 0, out, len(out)):
            self.now += 1_000_000
            for answer in node.receive(bytes(ffi.buffer(out)[:size])):
                lib.io_received(self.bus, answer, len(answer), self.now)
            lib.io_handle_time(self.bus, self.now)


def test_another_driver_takes_the_threads_place() -> None:
    driver, node, inbox = ByHand(), NodeTwin(7), Inbox()
    io = LinkIO.driven_by(driver, on_closed=inbox.on_closed)
    assert io.name == "by hand"
    link = io.open_link(LinkSettings(None), on_responses=inbox.on_responses, on_lost=inbox.on_lost)
    for i in range(20):
        link.send(ask(i))
    driver.exchange(node)
    assert driver.noticed == 1
    assert driver.handler
    driver.handler()
    assert len(inbox.responses) == 20
    assert 1_000_000_000 < inbox.responses[0].received_ns <= inbox.responses[-1].received_ns <= driver.now
    assert node.executed == [ask(i) for i in range(20)]
    link.send(ask(99))
    driver.exchange(node)
    assert driver.noticed == 2, "told again after all was taken"
    lib.io_end(driver.bus, 5)
    driver.handler()
    assert inbox.closed[0].startswith("by hand: the connection ended (Input/output error)")
    io.close()
    io.close()
    assert driver.closed == 1


@pytest.mark.parametrize(
    ("bitrate", "ceiling", "queue_frames", "word"),
    [
        (-1, 0.9, 0, "a bus of -1 bit/s"),
        (10**9, 0.9, 0, "bit/s"),
        (500_000, 0.05, 0, "a ceiling of 0.05"),
        (500_000, float("nan"), 0, "a ceiling of nan"),
        (500_000, 0.9, 1001, "a kernel queue of 1001 frames"),
    ],
)
def test_settings_out_of_range_are_refused_in_words(
    bitrate: int, ceiling: float, queue_frames: int, word: str
) -> None:
    with pytest.raises(LinkError, match=word):
        BusSettings(bitrate, ceiling, queue_frames)

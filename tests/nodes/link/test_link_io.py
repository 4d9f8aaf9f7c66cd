"""The I/O thread and its Python skin over socket pairs, with twin nodes at the far end."""

import asyncio
import os
import pty
import struct
import time
import tty
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from nodes.link import LinkError, LinkIO, LinkSettings, TransportKind
from nodes.support.awake import WakingLoop
from tests.nodes.link.peers import TIMEOUT_S, Bench, FdTransport, Inbox, bench, open_files, pack_frame
from tests.nodes.link.twin import STOP, NodeTwin, answer, ask, store

KINDS = list(TransportKind)
LEAD_S = 600
"""Of motion that is sent as soon as it can be."""
"""How far ahead of its time motion is queued; longer than a busy computer can stand still."""
CAN_KINDS = [TransportKind.CAN_STREAM, TransportKind.CAN_PACKET]


def run(test: Coroutine[object, object, None]) -> None:
    async def limited() -> None:
        async with asyncio.timeout(2 * TIMEOUT_S):
            await test

    asyncio.run(limited())


def repeat(action: Callable[[], None]) -> None:
    """Do it until it is refused."""
    end_s = time.monotonic() + TIMEOUT_S
    while time.monotonic() < end_s:
        action()


def node_id(kind: TransportKind) -> int:
    return 0 if kind == TransportKind.BYTES else 4


def record(command: bytes, min_clock: int = 0, req_clock: int = 0) -> bytes:
    return struct.pack("=QQB", min_clock, req_clock, len(command)) + command


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("small_buffers", [False, True])
def test_commands_arrive_in_order_and_answers_come_back(kind: TransportKind, small_buffers: bool) -> None:
    async def test() -> None:
        node = NodeTwin(expected=9)
        with bench(kind, {node_id(kind): node}, small_buffers=small_buffers) as b:
            link = b.open(node_id(kind))
            commands = [store(i, i % 50) if i % 3 else ask(i) for i in range(400)]
            for command in commands:
                link.send(command)
            await b.inbox.until(lambda: len(b.inbox.responses) == 134)
            await link.drained()
            assert link.pending() == 0
            assert node.executed == commands
            assert [r.content for r in b.inbox.responses] == [answer(i) for i in range(0, 400, 3)]
            stats = link.stats()
            # Answers to repeated blocks have no time: a busy computer may have kept the twin waiting.
            timed = [r for r in b.inbox.responses if r.sent_ns]
            assert len(timed) == 134 or stats.blocks_repeated
            assert all(r.sent_ns < r.received_ns for r in timed)
            assert stats.commands_sent == 400
            assert stats.bytes_invalid == 0
            assert stats.srtt_s > 0
            assert b.io.stats().bytes_sent >= stats.bytes_sent

    run(test())


@pytest.mark.parametrize("kind", KINDS)
def test_a_batch_goes_as_motion_and_its_lead_is_measured(kind: TransportKind) -> None:
    async def test() -> None:
        node = NodeTwin()
        with bench(kind, {node_id(kind): node}) as b:
            link = b.open(node_id(kind))
            now_ns = int(asyncio.get_running_loop().time() * 1e9)
            link.set_clock(1e6, now_ns, 5_000_000)
            due = 5_000_000 + LEAD_S * 1_000_000
            commands = [store(i, 4) for i in range(2000)]
            link.send_batch(b"".join(record(c, 0, due) for c in commands))
            await link.drained()
            assert node.executed == commands
            stats = link.stats()
            assert stats.lead_count == sum(stats.lead_histogram) == 2000
            assert stats.min_lead_s is not None
            assert 0 < stats.min_lead_s < LEAD_S
            assert stats.motion_commands_max == 2000
            assert stats.motion_commands == stats.motion_bytes == 0

    run(test())


@pytest.mark.parametrize("kind", CAN_KINDS)
def test_other_frames_go_to_python_and_come_from_it(kind: TransportKind) -> None:
    async def test() -> None:
        with bench(kind, {}) as b:
            b.open(4)
            b.io.send_frame(0x3F0, b"\x00")
            async with asyncio.timeout(TIMEOUT_S):
                await b.peer.frame_arrived.wait()
            assert b.peer.frames == [(0x3F0, b"\x00")]
            for can_id in (0x3F1, 0x107, 0x108, 0x80000109, 0x40000109, 0x305):
                b.peer.send(pack_frame(can_id, b"12345678"))
            await b.inbox.until(lambda: len(b.inbox.frames) == 6)
            assert [f.can_id for f in b.inbox.frames] == [0x3F1, 0x107, 0x108, 0x80000109, 0x40000109, 0x305]
            assert all(f.data == b"12345678" and f.received_ns > 0 for f in b.inbox.frames)
            with pytest.raises(LinkError, match="a frame of 9 bytes"):
                b.io.send_frame(0x3F0, bytes(9))

    run(test())


@pytest.mark.parametrize("kind", KINDS)
def test_a_deaf_peer_stops_sending_without_loss_or_spinning(kind: TransportKind) -> None:
    async def test() -> None:
        node = NodeTwin()
        with bench(kind, {node_id(kind): node}, small_buffers=True) as b:
            link = b.open(node_id(kind))
            link.send(ask(1))
            await b.inbox.until(lambda: b.inbox.responses)
            await link.drained()
            b.peer.deafen()
            if kind != TransportKind.BYTES:
                await fill_up(b)
            commands = [store(i, 50) for i in range(30)]
            for command in commands:
                link.send(command)
            b.peer.listen()
            await link.drained()
            assert node.executed[1:] == commands

    run(test())


def yield_until(condition: Callable[[], object]) -> None:
    """Give the thread its turns until CONDITION is true."""
    end_s = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < end_s
        os.sched_yield()


async def fill_up(b: Bench) -> None:
    """Send admin frames, which know no window, until the kernel takes no more and they are refused.

    Nothing may be under way at the beginning, and nobody reads.
    """
    waits, began_s = b.io.stats().waits, time.monotonic()
    silent = b.open(9, lost_after_s=0.3)
    silent.send(ask(2))
    yield_until(lambda: silent.stats().blocks_sent)

    def refused() -> bool:
        kernel_full = b.io.stats().waits > waits  # before: the thread takes no frame from then on
        try:
            b.io.send_frame(0x3F0, bytes(8))
        except LinkError:
            return kernel_full
        return False

    yield_until(refused)
    with pytest.raises(LinkError, match="admin frames wait already"):
        b.io.send_frame(0x3F0, bytes(8))
    # Until the silent node is lost a thread that spins would wake thousands of times; a sound one wakes for
    # its timers alone, which come some ten times in a second.
    wakeups = b.io.stats().wakeups
    await b.inbox.until(lambda: b.inbox.lost)
    assert b.io.stats().wakeups - wakeups < 50 + 50 * (time.monotonic() - began_s)


@pytest.mark.parametrize("kind", KINDS)
def test_a_silent_node_is_lost_once_and_the_others_go_on(kind: TransportKind) -> None:
    async def test() -> None:
        nodes = {} if kind == TransportKind.BYTES else {9: NodeTwin()}
        with bench(kind, {0: NodeTwin(window=0), **nodes}) as b:
            link = b.open(node_id(kind), lost_after_s=0.05)
            link.send(ask(1))
            with pytest.raises(LinkError, match=r"lost, no acknowledgement for 0\.05 s"):
                await link.drained()
            await b.inbox.until(lambda: b.inbox.lost)
            assert "does not answer at all" in b.inbox.lost[0]
            with pytest.raises(LinkError, match="lost"):
                link.send(ask(2))
            if nodes:
                other = b.open(9)
                other.send(ask(3))
                await b.inbox.until(lambda: b.inbox.responses)
            link.close()
            again = b.open(node_id(kind))
            again.close()
            again.close()
            assert len(b.inbox.lost) == 1

    run(test())


@pytest.mark.parametrize("kind", KINDS)
def test_a_peer_that_closes_is_told_once(kind: TransportKind) -> None:
    async def test() -> None:
        with bench(kind, {node_id(kind): NodeTwin()}) as b:
            link = b.open(node_id(kind))
            link.send(ask(1))
            await b.inbox.until(lambda: b.inbox.responses)
            b.peer.close()
            # Who calls before the loop was told learns as much.
            with pytest.raises(LinkError, match=r"pair: the connection ended \("):
                repeat(lambda: link.set_clock(1e6, 1, 1))
            await b.inbox.until(lambda: b.inbox.closed)
            assert b.inbox.closed[0].startswith("pair: the connection ended (")
            with pytest.raises(LinkError, match="the connection ended"):
                link.send(ask(2))
            with pytest.raises(LinkError, match="the connection ended"):
                await link.drained()
            with pytest.raises(LinkError):
                b.open(77 if node_id(kind) else 0)
            assert link.stats().commands_sent == 1
            assert b.inbox.lost == []

    run(test())


def test_a_pseudo_terminal_carries_a_link_and_its_end_is_told() -> None:
    async def test() -> None:
        ours, theirs = pty.openpty()
        tty.setraw(theirs)
        os.set_blocking(theirs, False)
        node, inbox, loop = NodeTwin(3), Inbox(), asyncio.get_running_loop()

        def serve() -> None:
            for block_ in node.receive(os.read(theirs, 4096)):
                os.write(theirs, block_)

        loop.add_reader(theirs, serve)
        transport = FdTransport("tty", TransportKind.BYTES, ours)
        io = LinkIO(transport, loop, on_closed=inbox.on_closed)
        link = io.open_link(LinkSettings(None), on_responses=inbox.on_responses, on_lost=inbox.on_lost)
        for i in range(200):
            link.send(ask(i))
        await link.drained()
        await inbox.until(lambda: len(inbox.responses) == 200)
        assert link.stats().bytes_invalid == 0
        loop.remove_reader(theirs)
        os.close(theirs)
        await inbox.until(lambda: inbox.closed)
        assert "tty: the connection ended (Input/output error)" in inbox.closed[0]
        io.close()
        transport.close()

    run(test())


@pytest.mark.parametrize("kind", KINDS)
def test_close_during_traffic_joins_the_thread_and_leaks_nothing(kind: TransportKind) -> None:
    async def test() -> None:
        for _ in range(2):
            with bench(kind, {node_id(kind): NodeTwin()}) as b:
                link = b.open(node_id(kind))
                link.send_batch(b"".join(record(store(i, 40)) for i in range(3000)))
                link.send(ask(1))
                await b.inbox.until(lambda: b.inbox.responses)
                waiter = asyncio.ensure_future(link.drained())
                await asyncio.sleep(0)
                b.io.close()
                b.io.close()
                with pytest.raises(LinkError, match="closed by this program"):
                    await waiter
                with pytest.raises(LinkError, match="closed by this program"):
                    link.send(ask(2))
                with pytest.raises(LinkError, match="closed by this program"):
                    b.io.send_frame(0x3F0, b"")
                assert link.stats().commands_sent > 0
                assert b.io.stats().bytes_sent > 0

    run(test())
    before = open_files()
    run(test())
    assert open_files() <= before


def test_a_callback_may_close_the_bus() -> None:
    async def test() -> None:
        with bench(TransportKind.BYTES, {0: NodeTwin()}) as b:
            settings = LinkSettings(None)
            link = b.io.open_link(settings, on_responses=lambda _: b.io.close(), on_lost=b.inbox.on_lost)
            for i in range(20):
                link.send(ask(i))
            with pytest.raises(LinkError, match="closed by this program"):
                await link.drained()

    run(test())


def test_urgent_drops_what_is_queued() -> None:
    async def test() -> None:
        node = NodeTwin()
        with bench(TransportKind.CAN_STREAM, {4: node}) as b:
            link = b.open(4)
            link.send_batch(b"".join(record(store(i, 40)) for i in range(5000)))
            link.send_urgent(STOP)
            await link.drained()
            assert node.executed[-1] == STOP
            assert node.executed[:-1] == [store(i, 40) for i in range(len(node.executed) - 1)]
            assert len(node.executed) - 1 + link.stats().commands_dropped == 5000

    run(test())


def test_full_queues_and_bad_arguments_are_refused_in_words() -> None:
    async def test() -> None:
        with bench(TransportKind.CAN_STREAM, {4: NodeTwin()}) as b:
            link = b.open(4)
            batch = record(store(1, 40)) * 10000
            link.send_batch(batch)
            with pytest.raises(LinkError, match="does not fit into the motion queue"):
                link.send_batch(batch + batch)
            with pytest.raises(LinkError, match="ends within a record"):
                link.send_batch(batch[:-1][-70:])
            with pytest.raises(LinkError, match="a command of 60 bytes"):
                link.send(bytes(60))
            with pytest.raises(LinkError, match="a command of 0 bytes"):
                link.send_urgent(b"")
            with pytest.raises(LinkError, match=r"control queue .* is full"):
                repeat(lambda: link.send(ask(1), min_clock=1))  # no clock is known: it waits
            with pytest.raises(LinkError, match=r"bulk queue .* is full"):
                repeat(lambda: link.send(ask(1), min_clock=1, bulk=True))
            with pytest.raises(LinkError, match="cannot hold a block"):
                link.set_receive_window(63)
            for freq_hz in (0.0, -1.0, float("nan"), float("inf")):
                with pytest.raises(LinkError, match="not a clock"):
                    link.set_clock(freq_hz, 0, 0)
            for settings in (
                LinkSettings(None),
                LinkSettings(0),
                LinkSettings(256),
                LinkSettings(4),
                LinkSettings(5, receive_window=10),
                LinkSettings(5, lost_after_s=0.0),
            ):
                with pytest.raises(LinkError, match="pair: node"):
                    b.io.open_link(settings, on_responses=b.inbox.on_responses, on_lost=b.inbox.on_lost)

    run(test())


class Waking(asyncio.SelectorEventLoop, WakingLoop):
    """A loop that says when it is awake, when the test says so."""

    def __init__(self) -> None:
        super().__init__()
        self.looks: list[Callable[[], None]] = []
        self.also_by: int | None = None
        self.soon = 0
        """How often something was to be called soon."""

    def call_soon(self, *args: Any, **options: Any) -> asyncio.Handle:  # type: ignore[override]
        self.soon += 1
        return super().call_soon(*args, **options)

    def when_awake(self, call: Callable[[], None], *, also_by: int | None = None) -> Callable[[], None]:
        self.also_by = also_by
        self.looks.append(call)
        return lambda: self.looks.remove(call)

    def call_between(
        self, earliest_s: float, latest_s: float, call: Callable[[], None]
    ) -> Callable[[], None]:
        raise NotImplementedError


@pytest.mark.parametrize("kind", KINDS)
def test_what_may_wait_is_taken_when_the_loop_is_awake_or_asked_for(kind: TransportKind) -> None:
    async def test() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, Waking)
        with bench(kind, {node_id(kind): NodeTwin()}) as b:
            link = b.open(node_id(kind))
            (look,) = loop.looks
            soon = loop.soon
            look()
            assert loop.soon == soon, "nothing waits"
            link.let_wait(answer(1)[:1], 3600.0)
            for count in (1, 2):
                link.send(ask(count))
                async with asyncio.timeout(TIMEOUT_S):
                    while not b.io._lib.io_waits(b.io._bus.live()):  # noqa: ASYNC110  there is no event for it
                        await asyncio.sleep(0.001)
                assert len(b.inbox.responses) == count - 1
                if count == 1:
                    look()
                    await asyncio.sleep(0)
                else:
                    link.take()
                assert len(b.inbox.responses) == count
            link.hurry(hurry=True)
            link.send(ask(3))
            await b.inbox.until(lambda: len(b.inbox.responses) == 3)
            with pytest.raises(LinkError, match="no room to let responses with the id  wait"):
                link.let_wait(b"", 1.0)
            assert loop.also_by is not None
            assert loop.remove_reader(loop.also_by), "what wakes the others is what wakes the link"
        assert loop.looks == []

    with asyncio.Runner(loop_factory=Waking) as runner:
        runner.run(test())

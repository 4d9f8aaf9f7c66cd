"""What a Link in Python adds to the C one: words, clocks, waiting for drained(), the last counters."""

import asyncio
import errno
import gc
import struct
import weakref
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import pytest

from nodes.link import Link, LinkError, LinkIO, LinkSettings, LinkStats, Response
from nodes.link._link import ffi, lib
from nodes.link.handle import BusHandle
from nodes.link.interfaces import OnResponses
from tests.nodes.link.by_hand import START_NS, ByHand
from tests.nodes.link.peers import Inbox
from tests.nodes.link.twin import STOP, NodeTwin, answer, ask, store
from tests.wire_twin import block

if TYPE_CHECKING:
    from collections.abc import Callable

HZ = 1_000_000
NEVER = 2**64 - 1
START_TICKS = 5_000_000


def record(command: bytes, min_clock: int = 0, req_clock: int = 0) -> bytes:
    return struct.pack("=QQB", min_clock, req_clock, len(command)) + command


class Line:
    """One link on a serial line by hand, and its node."""

    def __init__(self, *, lost_after_s: float = 1.0, on_responses: OnResponses | None = None) -> None:
        self.driver = ByHand()
        self.inbox = Inbox()
        self.node = NodeTwin()
        self.io = LinkIO.driven_by(self.driver, on_closed=self.inbox.on_closed)
        self.link: Link = self.io.open_link(
            LinkSettings(None, lost_after_s=lost_after_s),
            on_responses=on_responses or self.inbox.on_responses,
            on_lost=self.inbox.on_lost,
        )

    def drain(self) -> None:
        self.driver.exchange({0: self.node}, lambda: not self.link.pending())
        self.driver.hand_over()

    def connected(self) -> "Line":
        self.link.send(store(0))
        self.drain()
        self.node.executed.clear()
        return self

    def lose(self) -> None:
        """Let the link be lost in C; Python has not taken the notice yet."""
        driver = self.driver
        driver.exchange(
            {0: NodeTwin(window=0)},
            lambda: bool(driver.noticed) and lib.io_deadline(driver.bus, driver.now) == NEVER,
        )

    def raw(self) -> Any:
        raw = ffi.new("struct io_link_stats *")
        assert lib.io_get_link_stats(self.driver.bus, 1, raw) == lib.IO_OK
        return raw


def run(test: Any) -> None:
    asyncio.run(test)


# -------------------------------------------------------------------------------------------------- commands


def test_control_has_no_time_of_its_own_by_default() -> None:
    line = Line().connected()
    line.link.set_clock(HZ, line.driver.now, START_TICKS)
    line.link.send(ask(1))
    due = START_TICKS + 24_000  # to go in some 2 ms: before control, which has 5
    line.link.send_batch(record(store(2), 0, due))
    line.drain()
    assert line.node.executed == [store(2), ask(1)]
    line.node.executed.clear()
    line.link.set_clock(HZ, line.driver.now, START_TICKS)
    line.link.send(ask(3), req_clock=START_TICKS + 1)
    line.link.send_batch(record(store(4), 0, due))
    line.drain()
    assert line.node.executed == [ask(3), store(4)]


def test_min_clock_holds_a_command_back() -> None:
    line = Line().connected()
    line.link.set_clock(HZ, line.driver.now, START_TICKS)
    line.link.send(ask(1), min_clock=START_TICKS + HZ)
    line.link.send(ask(2), bulk=True)
    start_ns = line.driver.now
    line.drain()
    assert line.node.executed == [ask(2), ask(1)]
    assert line.driver.now - start_ns > 1_000_000_000


def test_refusals_say_how_much_there_is_room_for() -> None:
    line = Line().connected()
    waits = START_TICKS  # no clock is known
    batch = record(store(1, 40), waits, waits) * 100
    line.link.send_batch(batch)
    free = lib.IO_MOTION_BYTES - len(batch)
    words = f"by hand: a batch of .* bytes .* the motion queue \\({free} of {lib.IO_MOTION_BYTES} free\\)"
    with pytest.raises(LinkError, match=words):
        line.link.send_batch(batch * (lib.IO_MOTION_BYTES // len(batch)))
    for bad in (batch[:-1], record(b"", waits), record(bytes(60), waits)):
        with pytest.raises(LinkError, match=rf"by hand: a batch of {len(bad)} bytes ends within a record"):
            line.link.send_batch(bad)
    for bulk, queue, limit in (
        (False, "control", lib.IO_CONTROL_BYTES),
        (True, "bulk", lib.IO_BULK_BYTES),
    ):
        for _ in range(limit // (25 + len(ask(1)))):  # with header and stamp
            line.link.send(ask(1), min_clock=waits, bulk=bulk)
        with pytest.raises(LinkError, match=rf"by hand: the {queue} queue \({limit} bytes\) is full"):
            line.link.send(ask(1), min_clock=waits, bulk=bulk)
    for size in (0, 60):
        with pytest.raises(LinkError, match=rf"by hand: a command of {size} bytes; a block holds 1\.\.59"):
            line.link.send(bytes(size))
        with pytest.raises(LinkError, match=rf"by hand: a command of {size} bytes; a block holds 1\.\.59"):
            line.link.send_urgent(bytes(size))
    assert line.link.stats().commands_dropped == 0
    waiting = line.link.pending()
    line.link.send_urgent(STOP)
    assert line.link.stats().commands_dropped == waiting
    assert line.link.pending() == 1


def test_a_window_is_that_of_a_block_at_least() -> None:
    line = Line().connected()
    line.link.set_receive_window(64)
    line.link.send(store(1, 50))
    line.link.send(store(2, 50))
    out = ffi.new("uint8_t[]", 1024)
    assert lib.io_next(line.driver.bus, line.driver.now, 0, out, 1024) == len(store(1, 50)) + 5
    assert lib.io_next(line.driver.bus, line.driver.now, 0, out, 1024) == 0
    with pytest.raises(LinkError, match="by hand: a receive window of 63 bytes cannot hold a block"):
        line.link.set_receive_window(63)


def test_a_serial_line_wants_room_for_the_longest_transmission() -> None:
    line = Line()
    line.link.send(ask(1))
    out = ffi.new("uint8_t[]", 144)
    assert lib.io_next(line.driver.bus, line.driver.now, 0, out, 143) == 0
    assert lib.io_next(line.driver.bus, line.driver.now, 0, out, 144) == 64


def test_a_clock_is_positive_and_finite() -> None:
    line = Line()
    for good in ((0.5, 0, 0), (1e9, 1, 0), (1e9, 0, 1)):
        line.link.set_clock(*good)
    nan, infinity = float("nan"), float("inf")
    for bad in ((0.0, 1, 1), (-0.5, 1, 1), (nan, 1, 1), (infinity, 1, 1), (1.0, -1, 1), (1.0, 1, -1)):
        with pytest.raises(LinkError, match=r"by hand: not a clock: .* estimate it again"):
            line.link.set_clock(*bad)


# --------------------------------------------------------------------------------------------------- waiting


def test_drained_waits_each_time_and_for_all() -> None:
    async def test() -> None:
        line = Line()
        for turn in range(2):
            line.link.send(ask(turn))
            waiters = [asyncio.ensure_future(line.link.drained()) for _ in range(2)]
            await asyncio.sleep(0)
            line.driver.hand_over()
            await asyncio.sleep(0)
            assert not any(waiter.done() for waiter in waiters), turn
            line.drain()
            await asyncio.gather(*waiters)
        waiter = asyncio.ensure_future(line.link.drained())  # with nothing to wait for
        await asyncio.sleep(0)
        line.driver.hand_over()
        await waiter

    run(test())


def test_who_gave_up_waiting_disturbs_nobody() -> None:
    """Whether the link is drained or closed afterwards, and without a word of a lost exception."""

    async def test(*, closed: bool) -> None:
        complaints: list[dict[str, Any]] = []
        asyncio.get_running_loop().set_exception_handler(lambda _, context: complaints.append(context))
        line = Line()
        line.link.send(ask(1))
        waiter = asyncio.ensure_future(line.link.drained())
        await asyncio.sleep(0)
        waiter.cancel()
        await asyncio.sleep(0)
        assert waiter.cancelled()
        if closed:
            line.link.close()
        else:
            line.drain()
        await asyncio.sleep(0)
        del line, waiter
        gc.collect()
        assert complaints == []

    run(test(closed=False))
    run(test(closed=True))


# ------------------------------------------------------------------------------------------------------ ends


def test_a_silent_node_is_lost_in_words() -> None:
    async def test() -> None:
        line = Line(lost_after_s=0.25)
        line.link.send(ask(1))
        waiter = asyncio.ensure_future(line.link.drained())
        await asyncio.sleep(0)
        line.lose()
        with pytest.raises(LinkError, match="by hand: the link is lost; open it again when the node is back"):
            line.link.send(ask(2))
        line.driver.hand_over()
        words = (
            r"by hand: lost, no acknowledgement for 0\.25 s, the node does not answer at all; "
            "check its power, cable and termination, and whether its firmware runs"
        )
        with pytest.raises(LinkError, match=words):
            await waiter
        assert len(line.inbox.lost) == 1
        with pytest.raises(LinkError, match=words):
            await line.link.drained()
        line.link.close()  # the first reason stays
        with pytest.raises(LinkError, match=words):
            line.link.send(ask(2))

    run(test())


def test_a_silent_node_is_told_of_before_it_is_lost() -> None:
    line = Line().connected()
    silent: list[int] = []
    line.link.on_silent = lambda: silent.append(line.driver.now)
    line.link.send(ask(1))
    asked_ns = line.driver.now
    line.driver.exchange({0: NodeTwin(window=0)}, lambda: bool(line.driver.noticed))
    line.driver.hand_over()
    [silent_ns] = silent
    assert lib.LINK_SILENCE_MS * 1_000_000 <= silent_ns - asked_ns < 500_000_000
    assert line.inbox.lost == []


def test_a_node_that_takes_nothing_is_lost_in_other_words() -> None:
    line = Line().connected()
    line.link.send(ask(1))
    out = ffi.new("uint8_t[]", 1024)
    assert lib.io_next(line.driver.bus, line.driver.now, 0, out, 1024) > 0
    line.driver.now += 1_000
    line.driver.receive(block(line.node.expected + 5))
    line.lose()
    line.driver.hand_over()
    assert "the node answers, but accepts nothing; check" in line.inbox.lost[0]


def test_an_ended_transport_ends_its_links() -> None:
    async def test() -> None:
        line = Line().connected()
        line.link.send(ask(1))
        waiter = asyncio.ensure_future(line.link.drained())
        await asyncio.sleep(0)
        lib.io_end(line.driver.bus, errno.ENODEV)
        words = r"by hand: the connection ended .*; the interface is gone: plug the adapter in, then start"
        calls: tuple[Callable[[], object], ...] = (
            lambda: line.link.send(ask(2)),
            lambda: line.link.send_batch(record(ask(2))),
            lambda: line.link.send_urgent(STOP),
            lambda: line.link.set_receive_window(64),
            lambda: line.link.set_clock(HZ, 1, 1),
        )
        for refused in calls:
            with pytest.raises(LinkError, match=words):
                refused()
        line.driver.hand_over()
        with pytest.raises(LinkError, match=words):
            await waiter
        with pytest.raises(LinkError, match=words):
            await line.link.drained()
        assert line.inbox.lost == []
        assert len(line.inbox.closed) == 1

    run(test())


def test_drained_learns_of_an_end_that_python_has_not_heard_of() -> None:
    async def test() -> None:
        line = Line().connected()
        lib.io_end(line.driver.bus, 0)
        with pytest.raises(LinkError, match="its other end closed it"):
            await line.link.drained()

    run(test())


def test_a_closed_link_keeps_its_last_counters_and_frees_its_place() -> None:
    line = Line().connected()
    line.link.send(ask(1))
    line.drain()
    last = line.link.stats()
    assert last.commands_sent == 2
    line.link.send(ask(2))
    assert line.link.name == "by hand"
    line.link.close()
    assert line.link.stats().pending == 1
    line.link.close()
    with pytest.raises(LinkError, match="by hand: the link was closed by this program"):
        line.link.send(ask(3))
    raw = ffi.new("struct io_link_stats *")
    assert lib.io_get_link_stats(line.driver.bus, 1, raw) == lib.IO_GONE
    line.io.open_link(LinkSettings(None), on_responses=line.inbox.on_responses, on_lost=line.inbox.on_lost)


# -------------------------------------------------------------------------------------------------- counters


def test_a_closed_link_is_kept_by_nobody() -> None:
    line = Line()
    kept = weakref.ref(line.link)
    line.link.close()
    del line.link
    gc.collect()
    assert kept() is None


def test_counters_are_those_of_the_c_core() -> None:
    line = Line()
    fresh = line.link.stats()
    assert fresh == LinkStats(rto_s=0.1, lead_histogram=(0,) * 16)
    line.connected()
    line.link.set_clock(HZ, line.driver.now, START_TICKS)
    commands = [record(store(i, 9), 0, START_TICKS + 900_000) for i in range(30)]
    line.link.send_batch(b"".join(commands))
    line.link.send(ask(1))
    line.link.send(ask(2), bulk=True)
    line.drain()
    line.link.send_batch(commands[0])
    line.link.send(ask(3), bulk=True)
    line.driver.receive(b"noise")
    stats, raw = line.link.stats(), line.raw()
    link = raw.link
    assert (stats.control_commands_max, stats.motion_commands_max, stats.bulk_commands_max) == (1, 30, 1)
    assert (stats.motion_commands, stats.bulk_commands, stats.control_commands) == (1, 1, 0)
    assert stats.motion_bytes == len(commands[0])
    assert stats.bulk_bytes == stats.bulk_bytes_max == 25 + len(ask(3))
    assert stats.control_bytes_max == 25 + max(len(ask(1)), len(store(0)))
    assert stats.lead_count == sum(stats.lead_histogram) == 30
    assert stats.min_lead_s == link.lead_min_ns * 1e-9
    assert stats.min_lead_s is not None
    assert 0.5 < stats.min_lead_s < 0.9
    assert (stats.srtt_s, stats.rttvar_s, stats.rto_s) == (
        link.srtt_ns * 1e-9,
        link.rttvar_ns * 1e-9,
        link.rto_ns * 1e-9,
    )
    assert 0 < stats.srtt_s < stats.rto_s < 0.1
    assert stats.pending == 2
    assert stats.bytes_invalid == link.bytes_invalid == 5
    assert stats.received.blocks == link.blocks_received == stats.blocks_received > 0
    for name in ("motion", "control", "bulk"):
        flow, number = getattr(stats, name), getattr(lib, f"LINK_{name.upper()}")
        assert flow.blocks == raw.flows[number].blocks
    assert stats.motion.blocks > 0
    names = {name for name, _ in ffi.typeof("struct link_stats").fields}
    for name, value in asdict(stats).items():
        if name in names and isinstance(value, int):
            assert value == getattr(link, name), name


# ------------------------------------------------------------------------------------------- the bus's words


@pytest.mark.parametrize(
    ("cause", "words"),
    [
        (0, "its other end closed it); check cable and device"),
        (errno.EIO, "Input/output error); check cable and device"),
        (
            errno.ENETDOWN,
            "Network is down); the interface was set down: set it up with 'ip link set by hand up'",
        ),
    ],
)
def test_an_end_says_what_to_do(cause: int, words: str) -> None:
    handle = BusHandle(ByHand())
    sentence = f"by hand: the connection ended ({words}, then start again"
    assert handle.ended_because(cause) == sentence
    lib.io_end(handle.live(), cause)
    with pytest.raises(LinkError) as raised:
        handle.check(lib.IO_CLOSED, "anywhere")
    assert str(raised.value) == sentence
    handle.close()


def test_a_handle_refuses_in_words_and_is_closed_once() -> None:
    driver = ByHand()
    handle = BusHandle(driver)
    assert handle.open
    assert handle.live() == driver.bus
    handle.check(lib.IO_OK, "by hand node 4")
    with pytest.raises(LinkError, match="by hand node 4: no memory for another link"):
        handle.check(lib.IO_NO_MEMORY, "by hand node 4")
    with pytest.raises(LinkError, match=rf"by hand node 4: refused by the bus \(status {lib.IO_INVALID}\)"):
        handle.check(lib.IO_INVALID, "by hand node 4")
    handle.close()
    assert not handle.open
    assert driver.closed == 1
    with pytest.raises(LinkError, match="by hand: closed by this program; open it again first"):
        handle.live()


def test_responses_are_handed_over_with_their_times() -> None:
    line = Line().connected()
    line.link.send(ask(7))
    asked_ns = line.driver.now
    line.drain()
    (response,) = line.inbox.responses
    assert response.content == answer(7)
    assert response.sent_ns == asked_ns
    assert START_NS < asked_ns < response.received_ns <= line.driver.now


def test_commands_that_follow_from_what_came_together_share_a_block() -> None:
    came: list[Sequence[Response]] = []

    def store_each(responses: Sequence[Response]) -> None:
        came.append(responses)
        for number in range(len(responses)):
            line.link.send(store(number))

    line = Line(on_responses=store_each).connected()
    for number in (7, 8):
        line.link.send(ask(number))
    line.drain()
    assert [len(responses) for responses in came] == [2]
    blocks = line.link.stats().control.blocks
    line.drain()
    assert line.node.executed[-2:] == [store(0), store(1)]
    assert line.link.stats().control.blocks == blocks + 1


def test_what_a_callback_sends_is_sent_though_it_fails_or_closes_the_bus() -> None:
    bugs: list[Any] = []
    closes = False

    def store_and_fail(_: Sequence[Response]) -> None:
        line.link.send(store(3))
        if closes:
            line.io.close()
        raise ZeroDivisionError

    async def main() -> None:
        nonlocal closes
        asyncio.get_running_loop().set_exception_handler(lambda _, context: bugs.append(context["exception"]))
        line.drain()
        line.drain()
        assert line.node.executed[-1] == store(3)
        closes = True
        for number in (7, 8):
            line.link.send(ask(number))
        line.drain()

    line = Line(on_responses=store_and_fail).connected()
    for number in (7, 8):
        line.link.send(ask(number))
    asyncio.run(main())
    assert [type(bug) for bug in bugs] == [ZeroDivisionError], "reported, once"
    assert not line.io._bus.open

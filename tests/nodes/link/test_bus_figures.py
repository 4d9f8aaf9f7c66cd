"""What LinkIO reports of a bus whose bit rate it knows, and how a bus is shared: all in virtual time."""

import asyncio
import struct

import pytest

from nodes.link import BusSettings, Link, LinkError, LinkIO, LinkSettings
from nodes.link._link import lib
from tests.nodes.link.by_hand import START_NS, ByHand
from tests.nodes.link.peers import Inbox
from tests.nodes.link.twin import NodeTwin, answer, ask, store
from tests.wire_twin import block

BITRATE = 1_000_000
RESPONSES_MAX = 4096


def record(command: bytes, req_clock: int = 0) -> bytes:
    return struct.pack("=QQB", 0, req_clock, len(command)) + command


class Bus:
    """A LinkIO on a bus by hand, and what it reported."""

    def __init__(self, *, serial: bool = False, bitrate: int = 0) -> None:
        self.driver = ByHand(serial=serial, bitrate=bitrate)
        self.inbox = Inbox()
        self.io = LinkIO.driven_by(self.driver, on_frame=self.inbox.on_frame, on_closed=self.inbox.on_closed)

    def open(self, node_id: int | None) -> Link:
        return self.io.open_link(
            LinkSettings(node_id), on_responses=self.inbox.on_responses, on_lost=self.inbox.on_lost
        )

    def converse(self, nodes: dict[int, NodeTwin], *links: Link) -> None:
        """Go on until everything is acknowledged."""
        self.driver.exchange(nodes, lambda: not any(link.pending() for link in links))
        self.driver.hand_over()


def test_a_known_bit_rate_gives_figures_and_forecasts() -> None:
    scene, node = Bus(bitrate=BITRATE), NodeTwin()
    io, link = scene.io, scene.open(4)
    link.set_clock(1e9, START_NS, START_NS)
    commands = [store(i, 8) for i in range(300)]
    link.send(store(1000, 40), bulk=True)
    link.send(ask(1))
    # 12 bytes each at 18.3 bits, 300 of them within 40 ms: 1.6 Mbit/s
    in_time = [record(c, START_NS + 2_000_000_000 + i * 133_000) for i, c in enumerate(commands)]
    link.send_batch(b"".join(in_time))
    scene.converse({4: node}, link)
    assert [response.content for response in scene.inbox.responses] == [answer(1)]
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
    due_ns = scene.driver.now + 2_000_000_000
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


@pytest.mark.parametrize("after_ns", [5_000_000_000, 6_123_456_789])
def test_motion_is_not_sent_further_ahead_than_a_node_may_go_on_alone(after_ns: int) -> None:
    scene, node = Bus(), NodeTwin()
    link = scene.open(4)
    link.set_clock(1e9, START_NS, START_NS)
    link.send_batch(record(store(1, 8), START_NS + after_ns))
    scene.driver.exchange({4: node}, lambda: bool(node.executed))
    ahead_ns = LinkSettings(4).ahead_s * 1e9
    assert 0.75 * ahead_ns - 1e6 < START_NS + after_ns - scene.driver.now < ahead_ns


def test_blocks_of_one_link_share_frames() -> None:
    scene, node = Bus(), NodeTwin()
    link = scene.open(4)
    commands = [store(i, 50) for i in range(90)]
    link.send_batch(b"".join(record(c) for c in commands))
    scene.converse({4: node}, link)
    assert node.executed == commands
    # Each command is a block of its own. A frame that is not full ends a run of blocks.
    blocks = link.stats().blocks_sent
    short = sum(len(data) < 8 for _, data in scene.driver.frames)
    assert blocks >= 90
    assert short < blocks / 2, "most blocks begin in the frame in which the one before ends"


def test_four_links_share_a_bus() -> None:
    scene = Bus(bitrate=BITRATE)
    nodes = {i: NodeTwin(expected=i & 15) for i in (1, 4, 5, 255)}
    links = {i: scene.open(i) for i in nodes}
    commands = {i: [store(i * 1000 + k, 30) for k in range(150)] for i in nodes}
    for i, link in links.items():
        link.send_batch(b"".join(record(c) for c in commands[i]))
    scene.converse(nodes, *links.values())
    assert {i: node.executed for i, node in nodes.items()} == commands
    # Equal among equals: nobody is served last.
    order = [(can_id - 0x100) // 2 for can_id, _ in scene.driver.frames]
    half = order[: len(order) // 2]
    assert min(half.count(i) for i in nodes) > len(half) / 5
    assert scene.io.stats().frames_sent == len(order)


def test_a_silent_node_is_lost_once_after_the_time_that_was_set() -> None:
    scene = Bus()
    link = scene.open(4)
    link.send(ask(1))
    scene.driver.exchange({}, lambda: bool(scene.driver.noticed))
    scene.driver.hand_over()
    assert len(scene.inbox.lost) == 1
    lost_after_ns = LinkSettings(4).lost_after_s * 1e9
    assert lost_after_ns <= scene.driver.now - START_NS < lost_after_ns + 3_000_000_000
    with pytest.raises(LinkError, match="lost"):
        link.send(ask(2))


def test_when_python_is_slow_old_responses_give_way_and_motion_goes_on() -> None:
    scene, node = Bus(serial=True), NodeTwin()
    link = scene.open(None)
    link.send(store(1))
    scene.converse({0: node}, link)
    total = 2 * RESPONSES_MAX + 800
    for i in range(total):  # nothing is handed over meanwhile: Python is slow
        scene.driver.receive(block(node.expected, answer(i)))
    link.send(store(2))
    scene.driver.exchange({0: node}, lambda: not link.pending())
    assert node.executed == [store(1), store(2)]

    async def hand_over() -> None:
        scene.driver.hand_over()
        for _ in range(RESPONSES_MAX):  # turns of the loop, more than it takes
            await asyncio.sleep(0)

    asyncio.run(hand_over())
    stats = scene.io.stats()
    assert stats.responses_max == RESPONSES_MAX
    assert stats.responses_dropped == total - RESPONSES_MAX
    kept = [answer(i) for i in range(total - RESPONSES_MAX, total)]
    assert [response.content for response in scene.inbox.responses] == kept


def test_another_driver_takes_the_threads_place() -> None:
    scene, node = Bus(serial=True), NodeTwin(7)
    driver, inbox, link = scene.driver, scene.inbox, scene.open(None)
    assert scene.io.name == "by hand"
    for i in range(20):
        link.send(ask(i))
    driver.exchange({0: node}, lambda: not link.pending())
    assert driver.noticed == 1
    driver.hand_over()
    assert len(inbox.responses) == 20
    assert START_NS < inbox.responses[0].received_ns <= inbox.responses[-1].received_ns <= driver.now
    assert node.executed == [ask(i) for i in range(20)]
    link.send(ask(99))
    driver.exchange({0: node}, lambda: not link.pending())
    assert driver.noticed == 2, "notified again after all was taken"
    lib.io_end(driver.bus, 5)
    driver.hand_over()
    assert inbox.closed[0].startswith("by hand: the connection ended (Input/output error)")
    scene.io.close()
    scene.io.close()
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

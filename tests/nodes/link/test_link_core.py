"""The C link under virtual time: window, sequence, clocks, order, loss of the link."""

import struct
from collections.abc import Iterable

import pytest

from nodes.link._link import lib
from tests.nodes.link.twin import STOP, NodeTwin, WindowObserver, answer, ask, store
from tests.nodes.link.virtual import MS, NEVER, TO_HOST, TO_NODE, CoreLink, Delivery, Line
from tests.wire_twin import block

HZ = 1_000_000


def record(command: bytes, min_clock: int = 0, req_clock: int = 0) -> bytes:
    return struct.pack("=QQB", min_clock, req_clock, len(command)) + command


def connected(
    expected: int = 0, *, window: int = 192, lost_after_ns: int = 1000 * MS, delay_ns: int = MS
) -> Line:
    """Return a line whose first contact is over."""
    link, observer = CoreLink(window, lost_after_ns), WindowObserver(window)
    line = Line(link, NodeTwin(expected, max(window, 192)), delay_ns=delay_ns, observer=observer)
    line.link.send(store(0))
    line.run()
    assert line.node.executed == [store(0)]
    line.node.executed.clear()
    line.sent.clear()
    return line


@pytest.mark.parametrize("expected", range(16))
@pytest.mark.parametrize("lost_answers", [0, 1, 2])
def test_any_expected_sequence_is_adopted_without_loss(expected: int, lost_answers: int) -> None:
    def fault(way: int, index: int, data: bytes) -> Iterable[Delivery]:
        return [] if way == TO_HOST and index < lost_answers else [(0, data)]

    line = Line(CoreLink(), NodeTwin(expected), fault, observer=WindowObserver())
    commands = [store(i, 20) for i in range(5)]
    for command in commands:
        line.link.send(command)
    line.run()
    assert line.node.executed == commands


@pytest.mark.parametrize("expected", range(16))
def test_left_overs_of_an_earlier_host_do_no_harm(expected: int) -> None:
    """Half a block waits in the node, and old answers with any sequence wait in the host's buffers."""
    for left_over in range(64):
        node = NodeTwin(expected)
        node.receive(bytes([left_over]) if left_over >= 5 else block(0, bytes(40))[: left_over + 3])
        line = Line(CoreLink(), node)
        line.link.receive(block(left_over & 15, answer(1)) + block(left_over & 15), line.now)
        line.link.send(store(1, 3))
        line.run()
        assert node.executed == [store(1, 3)], left_over


def test_sequence_over_many_wraps() -> None:
    line = connected(expected=11)
    commands = [store(i, 50) for i in range(5000)]
    for command in commands:
        assert line.link.send_batch(record(command)) == lib.LINK_OK
        while line.link.pending() > 20:
            line.step()
    line.run()
    assert line.node.executed == commands
    assert line.link.stats.blocks_repeated == 0


def test_small_commands_are_packed_into_full_blocks() -> None:
    line = connected()
    for i in range(100):
        line.link.send(store(i % 90))
    line.run()
    assert all(len(data) >= 62 for data in line.sent[:-1])


def test_never_sixteen_blocks_in_flight() -> None:
    """With a huge window and one-command blocks the sequence is the bound: 15."""
    line = connected(window=4096, delay_ns=45 * MS)
    for i in range(40):
        line.link.send(store(i, 30))
    line.run()
    assert line.observer is not None
    assert line.observer.most_blocks == 15
    assert line.link.stats.blocks_repeated == 0


@pytest.mark.parametrize("window", [64, 65, 100, 128, 192, 500])
def test_the_window_bounds_unacknowledged_bytes(window: int) -> None:
    line = connected(window=window)
    commands = [store(i, i % 54) for i in range(200)]
    for command in commands:
        line.link.send_batch(record(command))
    line.run()
    assert line.node.executed == commands
    assert line.node.overflows == 0
    assert line.observer is not None
    assert line.observer.most_bytes > window - 64


def test_an_acknowledgement_of_what_was_never_sent_is_ignored_and_counted() -> None:
    line = connected()
    line.link.send(store(1, 50))
    line.pump()
    expected = line.node.expected
    for ahead in range(2, 16):
        line.link.receive(block(expected + ahead), line.now)
        assert line.link.pending() == 1
        assert line.link.stats.acks_never_sent == ahead - 1
    line.run()
    assert line.node.executed == [store(1, 50)]


def test_a_block_may_pause_on_its_way_but_a_rest_that_does_not_come_is_not_waited_for() -> None:
    line = connected()
    sound = block(line.node.expected, answer(7))
    for size in range(1, len(sound)):
        assert line.link.receive(sound[:size], line.now) == []
        line.now += 95 * MS
        assert line.link.receive(b"", line.now) == []
        assert [content for content, _ in line.link.receive(sound[size:], line.now)] == [answer(7)]
    assert line.link.stats.bytes_invalid == 0
    line.link.receive(sound[:-1], line.now)
    line.now += 105 * MS
    assert line.link.receive(b"", line.now) == []
    assert line.link.stats.bytes_invalid == len(sound) - 1
    assert [content for content, _ in line.link.receive(sound, line.now)] == [answer(7)]


def test_who_stood_still_waits_for_the_rest_of_a_block_once_more() -> None:
    """A busy computer may keep from its turn who reads and who sends: a response is never sent again."""
    line = connected()
    sound = block(line.node.expected, answer(7))
    for size in range(1, len(sound)):
        assert line.link.receive(sound[:size], line.now) == []
        for wait in (400 * MS, 95 * MS):
            line.now += wait
            assert line.link.receive(b"", line.now) == []
        assert [content for content, _ in line.link.receive(sound[size:], line.now)] == [answer(7)]
    assert line.link.stats.bytes_invalid == 0
    line.link.receive(sound[:-1], line.now)
    for bytes_invalid in (0, len(sound) - 1):
        line.now += 400 * MS
        assert line.link.receive(b"", line.now) == []
        assert line.link.stats.bytes_invalid == bytes_invalid


def test_a_repeat_starts_with_a_sync_byte_and_a_timeout_flushes_the_node() -> None:
    line = connected()
    line.fault = lambda way, index, data: []
    line.link.send(store(1))
    line.pump()
    line.step()
    line.pump()
    first, repeat = line.sent
    assert repeat.endswith(first)
    lead_in = repeat[: -len(first)]
    assert lead_in == bytes(len(lead_in) - 1) + b"~"  # else only a checksum rejects what it completes
    assert len(repeat) >= 64


def test_a_nak_repeats_at_once_and_the_round_trip_is_not_measured_by_repeats() -> None:
    line = connected()
    srtt_ns = line.link.stats.srtt_ns
    assert srtt_ns == 2 * MS
    start_ns = line.now
    lost = line.counts[TO_NODE]

    def fault(way: int, index: int, data: bytes) -> Iterable[Delivery]:
        return [] if (way, index) == (TO_NODE, lost) else [(0, data)]

    line.fault = fault
    for i in range(3):
        line.link.send(store(i, 50))
    line.run()
    assert line.link.stats.timeouts == 0
    assert line.link.stats.naks >= 1
    assert line.link.stats.srtt_ns == srtt_ns
    assert line.now - start_ns < 6 * MS


def test_a_repeated_block_gives_a_lower_bound_of_the_round_trip() -> None:
    """Whether the answer belongs to the block or to its repeat cannot be known: only the later counts."""
    line = connected()
    late = line.counts[TO_NODE]
    line.fault = lambda way, index, data: [(21 * MS if (way, index) == (TO_NODE, late) else 0, data)]
    line.link.send(store(1))
    line.run()
    assert line.link.stats.timeouts == 1
    assert line.link.stats.srtt_ns == (7 * 2 * MS + 3 * MS) // 8
    assert line.link.stats.rto_ns == 20 * MS


def test_responses_tell_when_their_question_was_sent_unless_it_was_repeated() -> None:
    line = connected()
    asked_ns = line.now
    line.link.send(ask(1))
    line.run()
    assert line.responses == [(answer(1), asked_ns)]
    lost = line.counts[TO_NODE]
    line.fault = lambda way, index, data: [] if (way, index) == (TO_NODE, lost) else [(0, data)]
    line.link.send(ask(2))
    line.run()
    assert line.responses[1:] == [(answer(2), 0)]


@pytest.mark.parametrize("start", [0, 2**32 - HZ // 2, 2**40 - 1])
def test_min_clock_gates_each_queue_also_across_the_rollover(start: int) -> None:
    line = connected()
    begin_ns = line.now
    line.link.set_clock(HZ, begin_ns, start)
    arrivals: dict[bytes, int] = {}
    gates = {store(i, 50): start + i * HZ // 10 for i in range(1, 11)}
    for command, gate in gates.items():
        line.link.send_batch(record(command, gate, gate + HZ))
    line.link.send(store(90), min_clock=start + HZ // 4)
    gates[store(90)] = start + HZ // 4
    while line.link.pending():
        line.step()
        for command in line.node.executed[len(arrivals) :]:
            arrivals[command] = line.now
    for command, gate in gates.items():
        # Timers free slots up to a millisecond late, and the clock is an estimate.
        sure_ns = begin_ns + (gate - start) * 1000 + 2 * MS
        assert sure_ns + MS <= arrivals[command] <= sure_ns + 2 * MS, gate
    assert line.link.stats.lead_count == 10
    assert 990 * MS < line.link.stats.lead_min_ns < 1000 * MS


def test_without_a_clock_gated_commands_wait_and_others_go() -> None:
    line = connected()
    line.link.send_batch(record(store(1), 5, 5))
    line.link.send(store(2))
    line.run(until_ns=line.now + 100 * MS)
    assert line.node.executed == [store(2)]
    assert line.link.deadline(line.now) == NEVER
    line.link.set_clock(HZ, line.now, 10)
    line.run()
    assert line.node.executed == [store(2), store(1)]


def test_commands_due_beyond_the_reach_of_32_bits_are_held_back() -> None:
    line = connected()
    line.link.set_clock(HZ, line.now, 0)
    due = 2**31 + 5
    start_ns = line.now
    line.link.send_batch(record(store(1), 0, due))
    line.run(limit_ns=4_000_000 * MS)
    sent_clock = (line.now - start_ns) // 1000
    assert due - sent_clock < 2**30 + HZ


def test_a_block_waits_for_its_fill_but_not_until_it_presses() -> None:
    line = connected()
    begin_ns = line.now
    line.link.set_clock(HZ, begin_ns, 0)
    for i in range(40):  # queue slots become free one by one, long before the commands are due
        line.link.send_batch(record(store(i, 6), i * 1000, 2 * HZ))
    line.run()
    assert len(line.sent) <= 8
    line.sent.clear()
    now = (line.now - begin_ns) // 1000
    line.link.send_batch(record(store(1), 0, now + HZ // 5) + record(store(2), now + HZ, now + 2 * HZ))
    line.run()
    assert line.node.executed[-2:] == [store(1), store(2)]
    assert line.link.stats.lead_min_ns > 90 * MS


def test_control_goes_before_motion_and_urgent_before_all() -> None:
    line = connected()
    motion = [store(i, 50) for i in range(30)]
    line.link.send_batch(b"".join(map(record, motion)))
    line.pump()
    in_flight = len(line.sent)
    line.link.send(store(80))
    line.step()
    line.step()
    line.pump()
    line.link.send(store(81))
    line.link.send_urgent(STOP)
    line.run()
    position = line.node.executed.index(store(80))
    assert position == in_flight
    assert line.node.executed[-1] == STOP
    assert store(81) not in line.node.executed
    done = len(line.node.executed) - 2
    assert [c for c in line.node.executed if c in motion] == motion[:done]
    assert line.link.stats.commands_dropped == 30 - done + 1


def test_urgent_overtakes_what_a_clock_holds_back() -> None:
    line = connected()
    line.link.send(store(1), min_clock=5)
    line.link.send_urgent(STOP)
    line.run()
    assert line.node.executed == [STOP]


@pytest.mark.parametrize("lost_after_ns", [200 * MS, 1000 * MS])
def test_silence_loses_the_link_once_and_in_time(lost_after_ns: int) -> None:
    line = connected(lost_after_ns=lost_after_ns)
    start_ns = line.now
    line.fault = lambda way, index, data: []
    line.link.send(store(1))
    while not line.link.lost:
        assert line.step()
        line.pump()
    assert line.now - start_ns == lost_after_ns
    assert line.link.c.cause == lib.LINK_CAUSE_SILENT
    assert 8 <= line.link.stats.timeouts <= 10
    assert line.link.send(store(2)) == line.link.send_urgent(STOP) == lib.LINK_GONE
    assert line.link.send_batch(record(store(2))) == lib.LINK_GONE
    assert line.link.next_block(line.now) == b""
    assert line.link.deadline(line.now) == NEVER


def test_a_node_that_answers_but_accepts_nothing_is_told_apart() -> None:
    line = connected()
    line.fault = lambda way, index, data: (
        [(0, data.replace(store(1), b"xxx"))] if way == TO_NODE else [(0, data)]
    )
    line.link.send(store(1))
    while not line.link.lost:
        assert line.step()
        line.pump()
    assert line.link.c.cause == lib.LINK_CAUSE_STUCK


def test_an_idle_link_is_never_lost() -> None:
    line = connected()
    assert line.link.deadline(line.now) == NEVER
    line.now += 3_600_000 * MS
    line.link.send(store(1))
    line.run()
    assert line.node.executed == [store(1)]


def test_repeated_refusals_of_the_first_contact_end_in_time() -> None:
    """Something that answers with ever other sequences is no node."""
    link = CoreLink()
    link.send(store(1))
    now, number = 1000 * MS, 0
    while not link.lost:
        link.handle_timer(now)
        now += 2 * MS
        if link.next_block(now):
            number += 7
            link.receive(block(number), now + MS)
        assert now < 3000 * MS


def test_lead_histogram_buckets() -> None:
    line = connected()
    line.link.set_clock(HZ, line.now, HZ)
    leads_ms = [-5, 1, 3, 100, 60_000]
    for lead_ms in leads_ms:
        now = int(line.now - line.link.c.clock_at_ns) // 1000 + HZ
        # Acknowledged after 2 ms; the lead is measured then.
        line.link.send_batch(record(store(1), 0, now + (lead_ms + 2) * 1000 + 500))
        line.run()
    histogram = list(line.link.stats.lead_histogram)
    assert histogram == [1, 0, 1, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 1]
    assert line.link.stats.lead_min_ns == -4_500_000


def test_an_offer_tells_class_and_deadline() -> None:
    line = connected()
    link, now = line.link, line.now
    assert link.offer(now) is None
    link.set_clock(HZ, now, 0)
    link.send_batch(record(store(1), 0, HZ))
    # Due in 1 s, of which a round trip (2 ms) and the least timeout (20 ms) are kept for a repeat.
    assert link.offer(now) == (lib.LINK_MOTION, now + 978 * MS, False)
    link.send(ask(3), now=now, bulk=True)
    assert link.offer(now) == (lib.LINK_MOTION, now + 978 * MS, False)
    link.send(store(2), now=now)
    assert link.offer(now) == (lib.LINK_CONTROL, now + 5 * MS, False)
    assert link.offer(now + 977 * MS) == (lib.LINK_CONTROL, now + 5 * MS, False)
    assert link.offer(now + 978 * MS) == (lib.LINK_MOTION, now + 978 * MS, True)
    assert link.offer(now, 1 << lib.LINK_BULK) == (lib.LINK_BULK, now + 1000 * MS, False)
    link.send_urgent(STOP)
    assert link.offer(now) == (lib.LINK_CONTROL, 0, True)


def test_a_block_is_filled_from_the_class_that_is_due_first() -> None:
    line = connected()
    link, now = line.link, line.now
    link.set_clock(HZ, now, 0)
    link.send(ask(3), now=now, bulk=True)
    link.send_batch(record(store(1, 3), 0, HZ) + record(store(4, 3), 0, HZ))
    link.send(store(2), now=now)
    line.run()
    assert line.node.executed == [store(2), store(1, 3), store(4, 3), ask(3)]


def test_bulk_leaves_a_block_of_the_window_to_others() -> None:
    line = connected()
    link, now = line.link, line.now
    for i in range(5):
        link.send(store(i, 50), now=now, bulk=True)
    assert [len(link.next_block(now)) for _ in range(3)] == [58, 58, 0]
    link.send(store(9, 50), now=now)
    assert len(link.next_block(now)) == 58

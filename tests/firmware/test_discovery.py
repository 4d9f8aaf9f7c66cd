"""Who is on the bus: answers that come apart, once for each query, in every state of a node."""

import random
from itertools import pairwise

import pytest

from tests.firmware.host import NODE_ID, Host
from tests.stages.sim_node import SimNode

ROLLOVER = 1 << 32
FREQ = 168_000_000
SPREAD = FREQ // 250
QUERY, WHO = b"\x00", b"\x41"
UUID = bytes.fromhex("0123456789ab")
ADMIN = 0x3F0
FRAME_TICKS = FREQ * 135 // 1_000_000
"""A full frame with every stuff bit, at 1 Mbit/s."""


def answers(node: SimNode, ticks: int) -> list[tuple[int, bytes, int]]:
    """Let TICKS pass; return (ticks from now, data, id) of what the node says."""
    begin = node.clock
    said = [(0, data, can_id) for can_id, data in node.take_frames()]
    while (deadline := node.next_deadline()) is not None and deadline <= begin + ticks:
        node.run_until(deadline)
        said += [(node.clock - begin, data, can_id) for can_id, data in node.take_frames()]
    node.run_until(begin + ticks)
    return said


def ask(node: SimNode, query: bytes) -> int:
    """Send QUERY, which must be answered once; return after how long."""
    node.receive_frame(ADMIN, query)
    ((delay, data, can_id),) = answers(node, 2 * SPREAD)
    assert can_id == 0x3F1
    assert data == (b"\x20" + UUID + b"\x01" if query == QUERY else b"\x21" + UUID + bytes([NODE_ID]))
    return delay


def fresh(start_clock: int = 0, *, legacy: bool = False) -> SimNode:
    return SimNode(UUID.hex(), start_clock, legacy=legacy)


def assign(node: SimNode) -> None:
    node.receive_frame(ADMIN, b"\x01" + UUID + bytes([NODE_ID]))
    assert node.node_id == NODE_ID


def test_boards_whose_uuids_differ_in_one_byte_alone_answer_apart() -> None:
    def delay(last: int) -> int:
        node = SimNode((UUID[:-1] + bytes([last])).hex(), 0)
        node.receive_frame(ADMIN, QUERY)
        ((found, _, _),) = answers(node, 2 * SPREAD)
        return found

    delays = [delay(last) for last in range(16)]
    assert len(set(delays)) == 16
    assert max(delays) - min(delays) > SPREAD // 2


@pytest.mark.parametrize("query", [QUERY, WHO])
def test_every_query_is_answered_once_after_a_time_drawn_anew(query: bytes) -> None:
    node = fresh(ROLLOVER - 20 * SPREAD)
    if query == WHO:
        assign(node)
    delays = [ask(node, query) for _ in range(200)]
    assert node.clock > ROLLOVER
    assert all(0 <= delay <= SPREAD for delay in delays)
    quarters = [sum(delay * 4 // SPREAD == quarter for delay in delays) for quarter in range(4)]
    assert min(quarters) > 30, "they fill the whole spread"
    assert len(set(delays)) > 190


def test_only_nodes_without_id_answer_one_query_and_only_nodes_with_one_the_other() -> None:
    node = fresh()
    assert answers(node, SPREAD) == [], "it says nothing unasked"
    node.receive_frame(ADMIN, WHO)
    assert answers(node, 2 * SPREAD) == []
    assign(node)
    node.receive_frame(ADMIN, QUERY)
    assert answers(node, 2 * SPREAD) == []
    node.reset()
    assert ask(node, QUERY) > 0


def test_queries_faster_than_answers_neither_put_them_off_nor_add_to_them() -> None:
    node = fresh(ROLLOVER - SPREAD // 2)
    asked, said = 0, 0
    since_last = 0
    for _ in range(4000):
        node.receive_frame(ADMIN, QUERY)
        asked += 1
        got = len(answers(node, SPREAD // 40))
        said += got
        since_last = 0 if got else since_last + 1
        assert since_last <= 41
    assert 4000 // 41 <= said <= asked


def test_an_answer_that_is_not_true_any_more_is_not_given() -> None:
    node = fresh()
    node.receive_frame(ADMIN, QUERY)
    assign(node)
    assert answers(node, 2 * SPREAD) == []
    node.receive_frame(ADMIN, WHO)
    node.receive_frame(ADMIN, b"\x01" + b"\xaa" * 6 + bytes([NODE_ID]))  # takes its id away
    assert answers(node, 2 * SPREAD) == []
    node.receive_frame(ADMIN, QUERY)
    assign(node)
    node.receive_frame(ADMIN, WHO)
    ((_, data, _),) = answers(node, 2 * SPREAD)
    assert data == b"\x21" + UUID + bytes([NODE_ID])


def test_a_node_that_is_shut_down_is_found() -> None:
    host = Host(transport="can", start_clock=ROLLOVER - 1000)
    host.configure("config_trsync oid=0")
    host.node.receive_frame(ADMIN, WHO)
    host.send("emergency_stop")  # forgets all timers
    host.send("config_reset")  # likewise
    host.send("emergency_stop")
    assert [data for _, data, _ in answers(host.node, SPREAD)] == [b"\x21" + UUID + bytes([NODE_ID])]
    assert ask(host.node, WHO) > 0
    host.node.receive_frame(ADMIN, b"\x01" + b"\xaa" * 6 + bytes([NODE_ID]))
    assert ask(host.node, QUERY) > 0


def test_older_firmware_answers_at_once_and_does_not_know_the_other_query() -> None:
    node = fresh(legacy=True)
    assert ask(node, QUERY) == 0
    assert ask(node, QUERY) == 0
    assign(node)
    node.receive_frame(ADMIN, WHO)
    assert answers(node, 2 * SPREAD) == []


def test_an_answer_which_the_board_refuses_comes_when_there_is_room() -> None:
    host = Host(transport="can")
    host.fill()
    host.node.receive_frame(ADMIN, WHO)
    host.node.run_until(host.now + 2 * SPREAD)
    said = host.node.take_frames()
    assert said.count((0x3F1, b"\x21" + UUID + bytes([NODE_ID]))) == 1


def test_two_chips_with_one_uuid_answer_apart() -> None:
    first, second = fresh(), fresh(12345)
    apart = [abs(ask(first, QUERY) - ask(second, QUERY)) for _ in range(20)]
    assert sum(ticks > FRAME_TICKS for ticks in apart) > 15


def clear_of_others(delays: dict[int, int]) -> set[int]:
    """Say who got through when two answers that begin within one frame's time spoil each other."""
    order = sorted(delays.items(), key=lambda item: item[1])
    spoilt: set[int] = set()
    for (one, early), (other, late) in pairwise(order):
        if late - early <= FRAME_TICKS:
            spoilt |= {one, other}
    return set(delays) - spoilt


@pytest.mark.parametrize("seed", range(20))
def test_sixteen_nodes_are_found_within_a_few_queries(seed: int) -> None:
    rng = random.Random(seed)
    uuids = [rng.randbytes(6) for _ in range(16)]
    nodes = [SimNode(uuid.hex(), rng.randrange(ROLLOVER)) for uuid in uuids]
    queries = 0
    while 0 in (ids := [node.node_id for node in nodes]):
        queries += 1
        assert queries <= 8, f"after 8 queries {ids.count(0)} nodes are not found"
        delays = {}
        for number, node in enumerate(nodes):
            node.receive_frame(ADMIN, QUERY)
            if said := answers(node, 2 * SPREAD):
                delays[number] = said[0][0]
        for number in clear_of_others(delays):  # who is found gets an id and is silent from then on
            nodes[number].receive_frame(ADMIN, b"\x01" + uuids[number] + bytes([number + 4]))

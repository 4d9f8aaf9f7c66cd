"""Asking who is on a bus: rounds, merging, twins, other hosts; without a bus."""

import random
from collections.abc import Callable

from canbus_tools.discovery.node_discovery import (
    LATE_NS,
    MAX_UUIDS,
    ROUND_NS,
    ROUNDS,
    ROUNDS_MAX,
    Application,
    DiscoveredNodes,
    NodeDiscovery,
)
from nodes.bus.assign import ANSWER_NS, Uuid
from nodes.support.can_protocol import ADMIN_ID, ADMIN_RESPONSE_ID, QUERY_UNASSIGNED, WHO_IS_HERE

A, B = Uuid(b"\x01" * 6), Uuid(b"\x02" * 6)
Answers = Callable[[int, int], list[bytes]]
"""What the nodes say in a round (from 1) to a question."""


def needs(uuid: Uuid, command: int = 1) -> bytes:
    return bytes([0x20, *uuid.raw, command])


def here(uuid: Uuid, nodeid: int) -> bytes:
    return bytes([0x21, *uuid.raw, nodeid])


def ask(answers: Answers, rounds: int = ROUNDS) -> tuple[DiscoveredNodes, list[list[int]]]:
    """Run a discovery; return its result and the questions of each round."""
    discovery = NodeDiscovery(rounds)
    discovery.start(0)
    asked: list[list[int]] = []
    while discovery.deadline_ns is not None:
        frames = discovery.frames_to_send()
        assert {frame.can_id for frame in frames} == {ADMIN_ID}
        asked.append([frame.data[0] for frame in frames])
        for frame in frames:
            for said in answers(len(asked), frame.data[0]):
                discovery.frame(ADMIN_RESPONSE_ID, said)
        discovery.timer(discovery.deadline_ns - 1)
        assert discovery.frames_to_send() == []
        wait(discovery)
    return discovery.result(), asked


def wait(discovery: NodeDiscovery) -> int:
    """Let the time pass until the discovery asks again or ends; return when (ns)."""
    asks = discovery.result().rounds
    at_ns = 0
    while discovery.deadline_ns is not None and discovery.result().rounds == asks:
        at_ns = discovery.deadline_ns
        discovery.timer(at_ns)
    return at_ns


def to_query(*said: bytes) -> Answers:
    return lambda _, question: list(said) if question == QUERY_UNASSIGNED else []


def test_the_question_that_is_answered_at_once_is_the_last_of_each_of_five_rounds() -> None:
    result, asked = ask(to_query())
    assert asked == [[WHO_IS_HERE, QUERY_UNASSIGNED]] * 5
    assert (result.waiting, result.here, result.rounds) == ((), (), 5)


def test_what_a_board_is_shows_in_the_command_it_understands() -> None:
    result, _ = ask(to_query(needs(B, 0x11), needs(A), needs(Uuid(b"\x03" * 6), 0x55)))
    assert [(node.uuid.raw[0], node.application, node.answers) for node in result.waiting] == [
        (1, Application.KLIPPER, 5),
        (2, Application.KATAPULT, 5),
        (3, Application.UNKNOWN, 5),
    ]
    assert result.twins == ()


def test_a_board_heard_once_in_five_rounds_is_found_and_gets_three_more_rounds_for_others() -> None:
    result, asked = ask(lambda n, question: [needs(A)] if n == 5 and question == QUERY_UNASSIGNED else [])
    assert [(node.uuid, node.answers) for node in result.waiting] == [(A, 1)]
    assert len(asked) == 8


def test_a_round_waits_longer_when_fewer_answer_than_before_but_not_for_ever() -> None:
    discovery = NodeDiscovery()
    discovery.start(0)
    for uuid in (A, B):
        discovery.frame(ADMIN_RESPONSE_ID, needs(uuid))
    first_ns = wait(discovery)
    discovery.frame(ADMIN_RESPONSE_ID, needs(A))
    second_ns = wait(discovery)
    assert second_ns - first_ns == ROUND_NS + 2 * ANSWER_NS + LATE_NS
    discovery.frame(ADMIN_RESPONSE_ID, needs(A))
    assert discovery.deadline_ns is not None
    discovery.timer(discovery.deadline_ns)
    assert discovery.result().rounds == 3  # it waits …
    discovery.frame(ADMIN_RESPONSE_ID, needs(B))
    assert wait(discovery) - second_ns == 2 * ROUND_NS + 2 * ANSWER_NS  # … until all have answered


def test_twins_show_by_one_answer_too_many() -> None:
    def said(n: int, question: int) -> list[bytes]:
        return [needs(A)] * (2 if n == 3 else 1) + [needs(B)] if question == QUERY_UNASSIGNED else []

    result, _ = ask(said)
    assert result.twins == (A,)


def test_twins_of_which_one_waits_or_with_different_ids_or_one_in_its_bootloader() -> None:
    one_waits, _ = ask(lambda _, question: [here(A, 4) if question == WHO_IS_HERE else needs(A)])
    two_ids, _ = ask(lambda n, question: [here(A, 4 + n % 2)] if question == WHO_IS_HERE else [])
    same_id, _ = ask(lambda _, question: [here(A, 4)] * 2 if question == WHO_IS_HERE else [])
    bootloader, _ = ask(lambda n, question: to_query(needs(A, 0x11 if n % 2 else 1))(n, question))
    for result in (one_waits, two_ids, same_id, bootloader):
        assert result.twins == (A,)
    assert [node.nodeid for node in two_ids.here] == [4, 5]


def test_a_board_that_gets_its_id_meanwhile_is_no_twin() -> None:
    def said(n: int, question: int) -> list[bytes]:
        return (
            [here(A, 4)] if n > 2 and question == WHO_IS_HERE else to_query(needs(A))(n, question) * (n < 3)
        )

    result, _ = ask(said)
    assert (result.waiting, result.here[0].answers, result.twins) == ((), 3, ())
    released, _ = ask(
        lambda n, question: [] if n < 3 and question == QUERY_UNASSIGNED else said(6 - n, question)
    )
    assert (released.waiting[0].uuid, released.here, released.twins) == (A, (), ())


def test_a_host_that_asks_too_makes_no_twins() -> None:
    discovery = NodeDiscovery()
    discovery.start(0)
    discovery.frame(ADMIN_ID, bytes([QUERY_UNASSIGNED]))
    discovery.frame(ADMIN_ID, bytes([WHO_IS_HERE]))
    discovery.frame(ADMIN_ID, b"")
    for said in (needs(A), here(B, 4)):
        discovery.frame(ADMIN_RESPONSE_ID, said)
        discovery.frame(ADMIN_RESPONSE_ID, said)
    assert discovery.result().twins == ()
    discovery.frame(ADMIN_RESPONSE_ID, needs(A))
    assert discovery.result().twins == (A,)


def test_traffic_is_told_by_who_sent_it() -> None:
    discovery = NodeDiscovery()
    for can_id in (0x108, 0x10B, 0x2FE, 0x2FF, 0x010, 0x101, 0x300, 0x7FF, 0x2000_0040):
        discovery.frame(can_id, b"\x05")
    result = discovery.result()
    assert (set(result.hosted), set(result.talking), result.foreign_frames) == ({4, 255}, {5, 255}, 5)


def test_garbage_is_counted_and_nothing_grows_without_end() -> None:
    source = random.Random(1)
    discovery = NodeDiscovery()
    discovery.start(0)
    for size in (0, 1, 7):
        discovery.frame(ADMIN_RESPONSE_ID, b"\x20" * size)
    discovery.frame(ADMIN_RESPONSE_ID, b"\x22" * 8)
    assert discovery.ignored == 4
    rounds = 1
    while discovery.deadline_ns is not None:
        for _ in range(10):
            discovery.frame(ADMIN_RESPONSE_ID, needs(Uuid(source.randbytes(6))))
        discovery.timer(discovery.deadline_ns)
        rounds += 1
    assert len(discovery.result().waiting) == MAX_UUIDS
    assert rounds < ROUNDS_MAX

"""Finding nodes whose answers collide, whose uuids or ids are not theirs alone, and many of them."""

import random
from dataclasses import dataclass, field

import pytest

from nodes.bus.assign import MAX_NS, AssignError, Assignment, IdAssignment, Uuid, number_nodes
from nodes.support.can_protocol import ADMIN_RESPONSE_ID, QUERY_UNASSIGNED, WHO_IS_HERE

MS = 1_000_000
FRAME_NS = 540_000
"""An answer on a bus of 250 kbit/s."""


def uuid(number: int) -> Uuid:
    return Uuid(bytes((0x90, 0xA4, 0xAE, 0, number >> 8, number & 255)))


@dataclass
class Board:
    """Answers after up to LATEST_NS: 0 is older firmware, which does not know WHO_IS_HERE either."""

    uuid: Uuid
    nodeid: int = 0
    latest_ns: int = 0
    shut_down: bool = False
    plugged_at_ns: int = 0

    def receive(self, data: bytes) -> bytes | None:
        if data[0] == QUERY_UNASSIGNED and not self.nodeid:
            return bytes((0x20, *self.uuid.raw, 1))
        if data[0] == WHO_IS_HERE and self.nodeid and self.latest_ns:
            return bytes((0x21, *self.uuid.raw, self.nodeid))
        if data[0] == 1 and data[1:7] == self.uuid.raw:
            self.nodeid = data[7]
        elif data[0] == 1 and data[7] == self.nodeid:
            self.nodeid, self.shut_down = 0, True
        return None


@dataclass
class CollidingBus:
    """Answers that begin in the same microsecond destroy each other unless they are equal: then they are one.

    Others queue behind each other. A destroyed answer is repeated at the same time as the other, in vain.
    """

    boards: list[Board]
    seed: int = 0
    now_ns: int = 0
    arriving: list[tuple[int, bytes]] = field(default_factory=list)

    def run(self, wanted: dict[Uuid, int]) -> Assignment:
        source = random.Random(self.seed)
        assignment = IdAssignment(wanted)
        assignment.start(0)
        while assignment.result is None:
            answers: dict[int, list[bytes]] = {}
            for frame in assignment.frames_to_send():
                for board in self.boards:
                    answer = board.receive(frame.data) if board.plugged_at_ns <= self.now_ns else None
                    if answer is not None:
                        at_us = self.now_ns // 1000 + source.randint(0, board.latest_ns // 1000)
                        answers.setdefault(at_us, []).append(answer)
            free_ns = self.now_ns
            for at_us in sorted(answers):
                if len(set(answers[at_us])) == 1:
                    free_ns = max(free_ns, at_us * 1000) + FRAME_NS
                    self.arriving.append((free_ns, answers[at_us][0]))
            assert assignment.deadline_ns is not None
            while self.arriving and self.arriving[0][0] <= assignment.deadline_ns:
                self.now_ns, data = self.arriving.pop(0)
                assignment.frame(ADMIN_RESPONSE_ID, data, self.now_ns)
            self.now_ns = assignment.deadline_ns
            assignment.timer(self.now_ns)
        for frame in assignment.frames_to_send():
            for board in self.boards:
                board.receive(frame.data)
        return assignment.result


@pytest.mark.parametrize("seed", range(5))
def test_sixty_four_nodes_of_our_firmware_get_their_ids_in_a_few_rounds(seed: int) -> None:
    boards = [Board(uuid(n), latest_ns=4 * MS) for n in range(64)]
    bus = CollidingBus(boards, seed)
    result = bus.run(wanted := number_nodes(board.uuid for board in boards))
    assert {board.uuid: board.nodeid for board in boards} == wanted
    assert (result.unheard, result.duplicates) == ((), ())
    assert bus.now_ns < 400 * MS


@pytest.mark.parametrize("count", [2, 64])
def test_older_boards_whose_answers_always_collide_get_their_ids_all_the_same(count: int) -> None:
    boards = [Board(uuid(n)) for n in range(count)]
    result = CollidingBus(boards).run(wanted := number_nodes(board.uuid for board in boards))
    assert {board.uuid: board.nodeid for board in boards} == wanted
    assert set(result.unheard) == set(wanted)  # whether they are there, identify shows
    result.check("can0")


@pytest.mark.parametrize("seed", range(5))
def test_older_boards_beside_ours(seed: int) -> None:
    boards = [Board(uuid(n), latest_ns=4 * MS * (n % 2)) for n in range(16)]
    result = CollidingBus(boards, seed).run(wanted := number_nodes(board.uuid for board in boards))
    assert {board.uuid: board.nodeid for board in boards} == wanted
    assert not {board.uuid for board in boards if board.latest_ns} & set(result.unheard)


def test_the_question_that_boards_answer_at_once_is_the_last_frame_of_its_round() -> None:
    assignment = IdAssignment(number_nodes([uuid(1)]))
    assignment.start(0)
    rounds = []
    while assignment.result is None:
        rounds.append([frame.data[0] for frame in assignment.frames_to_send()])
        assert assignment.deadline_ns is not None
        assignment.timer(assignment.deadline_ns)
    assert all(sent[-1] == QUERY_UNASSIGNED for sent in rounds)
    assert any(WHO_IS_HERE not in sent for sent in rounds)
    assert any(WHO_IS_HERE in sent for sent in rounds[4:])


def test_nobody_wanted_means_everybody_is_found() -> None:
    boards = [Board(uuid(n), latest_ns=4 * MS) for n in range(20)]
    boards.append(Board(uuid(99), latest_ns=4 * MS, plugged_at_ns=50 * MS))
    bus = CollidingBus(boards, seed=3)
    result = bus.run({})
    assert set(result.strangers) == {board.uuid for board in boards}
    assert all(board.nodeid == 0 for board in boards)
    assert bus.now_ns < 400 * MS


def test_new_uuids_without_end_do_not_keep_it_going() -> None:
    source = random.Random(1)
    assignment = IdAssignment(number_nodes([uuid(1)]))
    assignment.start(0)
    while assignment.result is None:
        assert assignment.deadline_ns is not None
        at_ns = assignment.deadline_ns
        assignment.frame(ADMIN_RESPONSE_ID, b"\x20" + source.randbytes(6) + b"\x01", at_ns - 1)
        assignment.timer(at_ns)
    assert MAX_NS <= at_ns < MAX_NS + 500 * MS


@pytest.mark.parametrize("seed", range(5))
def test_clones_that_have_the_id_already_are_reported(seed: int) -> None:
    boards = [Board(uuid(1), 4, 4 * MS), Board(uuid(1), 4, 4 * MS), Board(uuid(2), 5, 4 * MS)]
    result = CollidingBus(boards, seed).run(number_nodes([uuid(1), uuid(2)]))
    assert result.duplicates == (uuid(1),)
    with pytest.raises(AssignError, match="two boards on bus can0 have the uuid 90a4ae000001"):
        result.check_node(uuid(1), "can0")
    result.check_node(uuid(2), "can0")


def test_an_id_that_a_strange_board_has_is_taken_from_it_and_it_is_named() -> None:
    mine, strange = Board(uuid(1), 4, 4 * MS), Board(uuid(9), 4, 4 * MS)
    result = CollidingBus([mine, strange]).run(number_nodes([uuid(1)]))
    assert (mine.nodeid, mine.shut_down) == (4, False)
    assert (strange.nodeid, strange.shut_down) == (0, True)
    assert dict(result.displaced) == {uuid(9): 4}

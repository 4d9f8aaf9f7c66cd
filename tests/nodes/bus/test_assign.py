"""Node-id assignment on a simulated bus: loss, nodes with old ids, bootloaders, cloned boards, strangers."""

import random
from dataclasses import dataclass, field

import pytest

from nodes.bus.assign import PATIENCE_NS, AssignError, Assignment, IdAssignment, Uuid, number_nodes
from nodes.support.can_protocol import ADMIN_ID, ADMIN_RESPONSE_ID

MS = 1_000_000


def uuid(number: int) -> Uuid:
    return Uuid(bytes((0x90, 0xA4, 0xAE, 0, 0, number)))


@dataclass
class Board:
    """A node's side of the admin frames."""

    uuid: Uuid
    nodeid: int = 0
    set_command: int = 0x01
    boots_at_ns: int = 0
    knows_who_is_here: bool = False
    shut_down: bool = False

    def receive(self, data: bytes, now_ns: int) -> bytes | None:
        if now_ns < self.boots_at_ns:
            return None
        if data == b"\x00" and not self.nodeid:
            return bytes((0x20, *self.uuid.raw, self.set_command))
        if data == b"\x41" and self.nodeid and self.knows_who_is_here:
            return bytes((0x21, *self.uuid.raw, self.nodeid))
        if len(data) == 8 and data[0] == self.set_command:
            if data[1:7] == self.uuid.raw:
                self.nodeid = data[7]
            elif data[7] == self.nodeid:
                self.nodeid, self.shut_down = 0, True
        return None


@dataclass
class Bench:
    boards: list[Board]
    loss: float = 0.0
    seed: int = 0
    delay_ns: int = MS
    now_ns: int = 0
    sent: list[bytes] = field(default_factory=list)

    def run(self, wanted: dict[Uuid, int]) -> Assignment:
        source = random.Random(self.seed)
        assignment = IdAssignment(wanted)
        assignment.start(self.now_ns)
        arriving: list[tuple[int, bytes]] = []
        while assignment.result is None:
            for frame in assignment.frames_to_send():
                assert frame.can_id == ADMIN_ID
                self.sent.append(frame.data)
                for board in self.boards:
                    answer = None
                    if source.random() >= self.loss:
                        answer = board.receive(frame.data, self.now_ns)
                    if answer is not None and source.random() >= self.loss:
                        arriving.append((self.now_ns + self.delay_ns, answer))
            assert assignment.deadline_ns is not None
            due_ns = min([assignment.deadline_ns, *(t for t, _ in arriving)])
            self.now_ns = due_ns
            for answer in [data for t, data in arriving if t <= due_ns]:
                assignment.frame(ADMIN_RESPONSE_ID, answer, due_ns)
            arriving = [(t, data) for t, data in arriving if t > due_ns]
            assignment.timer(due_ns)
        return assignment.result


WANTED = number_nodes([uuid(1), uuid(2), uuid(3)])


def boards() -> list[Board]:
    return [Board(uuid(3)), Board(uuid(1)), Board(uuid(2))]


def test_ids_follow_the_order_of_the_configuration() -> None:
    bench = Bench(boards())
    result = bench.run(WANTED)
    assert {board.uuid: board.nodeid for board in bench.boards} == WANTED
    assert list(WANTED.values()) == [4, 5, 6]
    assert result == Assignment(WANTED, (), (), ())
    assert bench.now_ns < 150 * MS
    result.check("can0")


@pytest.mark.parametrize("seed", range(40))
def test_lost_frames_change_nothing(seed: int) -> None:
    bench = Bench(boards(), loss=0.05, seed=seed)
    result = bench.run(WANTED)
    assert {board.uuid: board.nodeid for board in bench.boards} == WANTED
    assert (result.unheard, result.duplicates) == ((), ())


@pytest.mark.parametrize("lost", range(12))
def test_any_single_lost_frame(lost: int) -> None:
    class Dropping(Board):
        seen = 0

        def receive(self, data: bytes, now_ns: int) -> bytes | None:
            Dropping.seen += 1
            return None if Dropping.seen - 1 == lost else super().receive(data, now_ns)

    bench = Bench([Dropping(uuid(1))])
    result = bench.run({uuid(1): 4})
    assert bench.boards[0].nodeid == 4
    assert result.unheard == ()


def test_a_node_that_boots_late_is_waited_for() -> None:
    bench = Bench([Board(uuid(1)), Board(uuid(2), boots_at_ns=900 * MS), Board(uuid(3))])
    result = bench.run(WANTED)
    assert {board.uuid: board.nodeid for board in bench.boards} == WANTED
    assert result.unheard in ((), (uuid(2),))


@pytest.mark.parametrize("knows_who_is_here", [False, True])
def test_a_node_with_an_old_id_is_told_the_new_one(knows_who_is_here: bool) -> None:
    old = [
        Board(uuid(n), nodeid=nodeid, knows_who_is_here=knows_who_is_here) for n, nodeid in ((1, 9), (2, 5))
    ]
    bench = Bench([*old, Board(uuid(3))])
    result = bench.run(WANTED)
    assert {board.uuid: board.nodeid for board in bench.boards} == WANTED
    # Without WHO_IS_HERE only talking to it tells.
    assert result.unheard == (() if knows_who_is_here else (uuid(1), uuid(2)))
    assert (bench.now_ns < 200 * MS) == knows_who_is_here


def test_nodes_whose_old_ids_are_swapped_end_up_right() -> None:
    bench = Bench([Board(uuid(1), nodeid=5), Board(uuid(2), nodeid=4)])
    wanted = number_nodes([uuid(1), uuid(2)])
    bench.run(wanted)
    assert {board.uuid: board.nodeid for board in bench.boards} == wanted


def test_a_missing_node_is_named_with_those_that_wait() -> None:
    bench = Bench([Board(uuid(1)), Board(uuid(8)), Board(uuid(9), set_command=0x11)])
    result = bench.run(number_nodes([uuid(1), uuid(2)]))
    assert result.unheard == (uuid(2),)
    assert PATIENCE_NS <= bench.now_ns < PATIENCE_NS + 200 * MS
    assert str(result.not_found(uuid(2), "can0")) == (
        "node 90a4ae000002 not found on bus can0; nodes waiting there: 90a4ae000008 (ready for an id), "
        "90a4ae000009 (in its bootloader); check its wiring and power, the bus's bit rate, and the uuid"
    )


def test_a_node_in_its_bootloader_is_said_to_be() -> None:
    bench = Bench([Board(uuid(1), set_command=0x11)])
    result = bench.run({uuid(1): 4})
    assert bench.boards[0].nodeid == 0
    assert result.in_bootloader == (uuid(1),)
    with pytest.raises(AssignError, match="bootloader"):
        result.check("can0")


def test_cloned_boards_are_reported_not_guessed() -> None:
    bench = Bench([Board(uuid(1)), Board(uuid(1)), Board(uuid(2))])
    result = bench.run(number_nodes([uuid(1), uuid(2)]))
    assert result.duplicates == (uuid(1),)
    with pytest.raises(AssignError, match="two boards on bus can0 have the uuid 90a4ae000001"):
        result.check("can0")


def test_answers_slower_than_a_round_are_no_duplicates() -> None:
    bench = Bench(boards(), delay_ns=45 * MS)
    result = bench.run(WANTED)
    assert result.duplicates == ()
    assert {board.uuid: board.nodeid for board in bench.boards} == WANTED


@pytest.mark.parametrize("seed", range(5))
def test_garbage_frames_are_ignored(seed: int) -> None:
    source = random.Random(seed)
    assignment = IdAssignment({uuid(1): 4})
    assignment.start(0)
    for i in range(5000):
        can_id = source.choice((ADMIN_RESPONSE_ID, ADMIN_ID, 0x108))
        assignment.frame(can_id, source.randbytes(source.randrange(9)), i)
    for _ in range(1000):
        assignment.frame(ADMIN_RESPONSE_ID, b"\x20" + source.randbytes(6) + b"\x01", 1)
    while assignment.result is None:
        assert assignment.deadline_ns is not None
        assignment.timer(assignment.deadline_ns)
    assert assignment.result.unheard == (uuid(1),)
    assert len(assignment.result.strangers) <= 512
    assert assignment.ignored_frames > 0


@pytest.mark.parametrize("text", ["", "90a4ae022df", "90a4ae022dfcc", "90a4ae022dfg", "0x90a4ae022d"])
def test_what_is_no_uuid_is_refused(text: str) -> None:
    with pytest.raises(AssignError, match="12 hex digits"):
        Uuid.parse(text)


def test_uuids_are_read_and_printed_in_wire_order() -> None:
    assert str(Uuid.parse(" 90A4ae022dfc ")) == "90a4ae022dfc"
    assert Uuid.parse("90a4ae022dfc").raw == bytes.fromhex("90a4ae022dfc")


def test_one_uuid_configured_twice_and_too_many_nodes_are_refused() -> None:
    with pytest.raises(AssignError, match="configured twice"):
        number_nodes([uuid(1), uuid(1)])
    with pytest.raises(AssignError, match="more than 252"):
        number_nodes(Uuid(bytes((0, 0, 0, 0, n >> 8, n & 255))) for n in range(253))

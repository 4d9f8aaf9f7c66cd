"""Each trap of the seed's pseudo code: what the literal peer does, and what ours does instead."""

import pytest

from nodes.mt.mt import (
    C_CKHIGH,
    C_CKLOW,
    C_MASK,
    C_START,
    ESC,
    LIT,
    VALUES,
    MtError,
    MtStatus,
    Pair,
    checksum,
    digest,
    mask_of,
    transmission,
)
from tests.nodes.mt import literal
from tests.nodes.mt.receiver import MtReceiver
from tests.nodes.mt.receivers import BOTH, FirmwareReceiver, feed

TABLE: tuple[Pair, ...] = ((-50_000, 12), (0, -7), (50_000, -7), (50_001, 0))
OTHER: tuple[Pair, ...] = ((1, 2), (3, 4))
ROOM = 16

Ours = type[MtReceiver] | type[FirmwareReceiver]
ours = pytest.mark.parametrize("ours", BOTH, ids=["python", "firmware"])


def raw(values: list[int], *, announced: int, mask: int = 1, total: int | None = None) -> list[int]:
    """Return a transmission of any VALUES, sound or not."""
    total = sum(values) & 0xFFFFFFFF if total is None else total
    head = [ESC, C_MASK, ESC, C_MASK | mask, C_CKHIGH | total >> 16, C_CKLOW | total & 0xFFFF]
    return [*head, C_START | announced, *(v & 0xFFFFFFFF for v in values), ESC, ESC, C_MASK]


# --------------------------------------------------------------------------------------------- i = 0..l


@ours
def test_the_inclusive_reading_is_a_length_error_for_everybody(ours: Ours) -> None:
    words = list(literal.send(TABLE, 1, inclusive=True))
    peer, receiver = literal.Receiver(1), ours(1, ROOM)
    for word in words:
        peer.read(word)
    feed(receiver, words)
    assert peer.table_status == literal.STATUS_LENGTH_ERROR
    assert receiver.status is MtStatus.LENGTH_ERROR


@ours
def test_l_is_the_number_of_pairs(ours: Ours) -> None:
    assert C_START | len(TABLE) in transmission(TABLE, [1])
    peer, receiver = literal.Receiver(1), ours(1, ROOM)
    for word in transmission(TABLE, [1]):
        peer.read(word)
    assert feed(receiver, literal.send(TABLE, 1)) == 1
    assert (peer.table_status, peer.table) == (literal.STATUS_OK, list(TABLE))
    assert (receiver.status, receiver.pairs) == (MtStatus.OK, TABLE)


# --------------------------------------------------------------------- receivers that are not selected


def crafted() -> list[int]:
    """Return a table for axle 1 whose values select axle 2 and bring it another one."""
    hidden = [C_MASK | 2, C_CKHIGH, C_CKLOW | 10, C_START | 2, 1, 2, 3, 4]
    return raw(hidden, announced=4)


def test_crafted_data_selects_the_literal_receiver() -> None:
    peer = literal.Receiver(2)
    for word in crafted():
        peer.read(word)
    assert peer.table == list(OTHER)


@ours
def test_a_receiver_that_is_not_selected_follows_the_modes_and_stores_nothing(ours: Ours) -> None:
    selected, other = ours(1, ROOM), ours(2, ROOM)
    assert feed(selected, crafted()) == 1
    assert feed(other, crafted()) == 0
    assert (other.status, other.pairs, other.generation) == (MtStatus.OK, (), 0)
    assert feed(other, transmission(OTHER, [2])) == 1


def test_what_a_sender_sends_cannot_select_a_literal_receiver_either() -> None:
    peer = literal.Receiver(2)
    edges = [VALUES[0], VALUES[-1], -1, 0]
    table = [(x, y) for x in edges for y in edges]
    for word in transmission(table, [1]):
        peer.read(word)
        assert not peer.is_selected


# ------------------------------------------------------------------------------------- change detection


@pytest.mark.parametrize("bad", [-(1 << 31), -(1 << 31) + 1, VALUES[0] - 1, VALUES[-1] + 1, C_START | 1])
@pytest.mark.parametrize("side", [0, 1])
def test_a_sender_refuses_what_a_register_or_a_lost_receiver_would_misread(bad: int, side: int) -> None:
    pair = (bad, 0) if side == 0 else (0, bad)
    with pytest.raises(MtError, match=rf"{'XY'[side]}\[1\] is {bad}; MT sends whole numbers from"):
        transmission([(0, 0), pair], [1])


def test_the_literal_sender_loses_such_values_in_a_register() -> None:
    for table in ([(literal.LIT, 5)], [(5, literal.ESC)], [(literal.START_ + 1, 0)]):
        peer, register = literal.Receiver(1), literal.ChangedOnly()
        for word in register.pass_on(literal.send(table, 1)):
            peer.read(word)
        assert peer.table_status != literal.STATUS_OK or peer.table_length == 0


@ours
def test_every_word_of_ours_differs_from_the_one_before_but_the_second_esc(ours: Ours) -> None:
    tables = (TABLE, (), ((0, 0),) * 5, ((-1, -1), (VALUES[0], VALUES[0]), (VALUES[-1], VALUES[-1])))
    register, receiver = literal.ChangedOnly(), ours(3, ROOM)
    for number, table in enumerate(tables):
        words = transmission(table, [3])
        seen = list(register.pass_on(iter(words)))
        assert seen == [*words[:-2], words[-1]]
        assert feed(receiver, seen) == 1
        assert (receiver.pairs, receiver.generation) == (table, number + 1)


@ours
def test_a_receiver_takes_the_full_range(ours: Ours) -> None:
    table = [(-(1 << 31), (1 << 31) - 1), (-(1 << 31) + 1, C_START), (C_MASK, C_MASK)]
    receiver = ours(1, ROOM)
    assert feed(receiver, literal.send(table, 1)) == 1
    assert receiver.pairs == tuple(table)


# -------------------------------------------------------------------------------------- resynchronising


def test_the_literal_preamble_does_not_free_a_receiver_stuck_in_a_literal_behind_a_register() -> None:
    peer, register = literal.Receiver(1), literal.ChangedOnly()
    stuck = [*transmission(OTHER, [1])[:8], LIT]
    for word in register.pass_on(iter([*stuck, *literal.send(TABLE, 1)])):
        peer.read(word)
    assert peer.table_status != literal.STATUS_OK or peer.table != list(TABLE)


@ours
@pytest.mark.parametrize("only_changes", [False, True])
def test_the_preamble_frees_a_receiver_whatever_it_lost_before(ours: Ours, *, only_changes: bool) -> None:
    """Cut a transmission anywhere, with a literal in it: the next one arrives."""
    doubled = ((5, 5), (5, 5), (6, 6))
    before = transmission(doubled, [1])
    assert LIT in before
    for cut in range(len(before)):
        receiver, register = ours(1, ROOM), literal.ChangedOnly()
        words = [*before[:cut], *transmission(TABLE, [1])]
        feed(receiver, register.pass_on(iter(words)) if only_changes else words)
        assert (receiver.status, receiver.pairs) == (MtStatus.OK, TABLE), f"cut at {cut}"


@ours
def test_the_end_frees_a_receiver_stuck_in_a_literal(ours: Ours) -> None:
    words = transmission(((5, 5),), [1])
    at = words.index(LIT)
    receiver = ours(1, ROOM)
    feed(receiver, [*words[: at + 1], *words[at + 2 :]])  # the value behind LIT is lost
    assert receiver.status is not MtStatus.TRANSMITTING
    assert receiver.generation == 0
    feed(receiver, [C_MASK | 1])  # it is in command mode, for it hears the next one without preamble
    feed(receiver, transmission(OTHER, [1])[4:])
    assert receiver.pairs == OTHER


@ours
def test_nobody_is_selected_after_the_end(ours: Ours) -> None:
    receiver = ours(1, ROOM)
    feed(receiver, transmission(TABLE, [1]))
    feed(receiver, transmission(OTHER, [1])[4:])  # its masks are lost
    assert (receiver.pairs, receiver.generation) == (TABLE, 1)


# ------------------------------------------------------------------------------------------- stale status


def test_the_literal_receiver_keeps_an_old_ok_when_a_start_is_lost() -> None:
    peer = literal.Receiver(1)
    for word in [*literal.send(TABLE, 1), *(w for w in literal.send(OTHER, 1) if w != C_START | 2)]:
        peer.read(word)
    assert (peer.table_status, peer.table) == (literal.STATUS_OK, list(TABLE))  # which one was it?


@ours
def test_a_lost_start_shows_in_the_generation(ours: Ours) -> None:
    receiver = ours(1, ROOM)
    feed(receiver, transmission(TABLE, [1]))
    feed(receiver, (w for w in transmission(OTHER, [1]) if w != C_START | 2))
    assert (receiver.status, receiver.generation, receiver.pairs) == (MtStatus.OK, 1, TABLE)


@ours
def test_the_status_is_transmitting_from_the_start_on(ours: Ours) -> None:
    receiver, words = ours(1, ROOM), transmission(TABLE, [1])
    start = words.index(C_START | len(TABLE))
    feed(receiver, words[:start])
    assert receiver.status is MtStatus.OK
    feed(receiver, words[start:-3])
    assert (receiver.status, receiver.pairs) == (MtStatus.TRANSMITTING, ())
    feed(receiver, words[-3:])
    assert (receiver.status, receiver.generation) == (MtStatus.OK, 1)


# ----------------------------------------------------------------------------------------------- checksum


def test_the_checksum_is_of_32_bits_in_two_halves_high_first() -> None:
    assert checksum([(-1, 0)]) == 0xFFFFFFFF
    words = transmission([(-1, 0)], [1])
    assert words[4:6] == [C_CKHIGH | 0xFFFF, C_CKLOW | 0xFFFF]


@ours
@pytest.mark.parametrize("lost", [4, 5])
def test_both_halves_must_have_come_since_the_mask(ours: Ours, lost: int) -> None:
    receiver, words = ours(1, ROOM), transmission(TABLE, [1])
    assert feed(receiver, words) == 1
    feed(receiver, words[:lost] + words[lost + 1 :])
    assert receiver.status is MtStatus.CHECKSUM_ERROR, "the half of the transmission before does not count"
    assert receiver.generation == 1


@ours
def test_a_low_half_replaces_and_has_to_follow_the_high_one(ours: Ours) -> None:
    receiver, words = ours(1, ROOM), transmission(TABLE, [1])
    feed(receiver, [*words[:4], C_CKHIGH | 0xABCD, C_CKLOW | 0xFFFF, *words[4:]])
    assert receiver.status is MtStatus.OK, "what came last counts, not what both together are"
    other = ours(1, ROOM)
    feed(other, [*words[:4], words[5], words[4], *words[6:]])
    assert other.status is MtStatus.CHECKSUM_ERROR


@ours
def test_a_wrong_value_is_a_checksum_error(ours: Ours) -> None:
    receiver = ours(1, ROOM)
    feed(receiver, raw([1, 2, 3, 4], announced=2, total=11))
    assert (receiver.status, receiver.generation) == (MtStatus.CHECKSUM_ERROR, 0)


@ours
def test_values_in_another_order_have_another_digest(ours: Ours) -> None:
    receiver = ours(1, ROOM)
    feed(receiver, transmission(((0, 1), (2, 3)), [1]))
    before = receiver.checksum, receiver.digest
    feed(receiver, transmission(((0, 3), (2, 1)), [1]))
    assert receiver.checksum == before[0]
    assert receiver.digest == digest(receiver.pairs) != before[1]


# ------------------------------------------------------------------------------------------------- length


@ours
@pytest.mark.parametrize(
    ("values", "announced"), [([1, 2, 3], 2), ([1, 2, 3], 1), ([1, 2, 3, 4, 5, 6], 2), ([], 1)]
)
def test_another_length_than_announced_is_an_error(ours: Ours, values: list[int], announced: int) -> None:
    receiver = ours(1, ROOM)
    feed(receiver, raw(values, announced=announced))
    assert (receiver.status, receiver.generation) == (MtStatus.LENGTH_ERROR, 0)


@ours
@pytest.mark.parametrize("announced", [ROOM + 1, 0x0FFFFFFF])
def test_more_than_there_is_room_for_is_an_error_and_nothing_is_stored_beyond(
    ours: Ours, announced: int
) -> None:
    receiver = ours(1, ROOM)
    feed(receiver, raw([1] * (2 * ROOM + 2), announced=announced))
    assert (receiver.status, receiver.pairs) == (MtStatus.LENGTH_ERROR, ())
    full = tuple((i, -i) for i in range(ROOM))
    assert feed(receiver, transmission(full, [1])) == 1
    assert receiver.pairs == full


# -------------------------------------------------------------------------------------------------- axles


@pytest.mark.parametrize("axle", [0, 29, -1])
def test_there_are_axles_1_to_28(axle: int) -> None:
    with pytest.raises(MtError, match=f"axles 1 to 28, not {axle}"):
        mask_of([1, axle])
    with pytest.raises(MtError, match=f"axles 1 to 28, not {axle}"):
        MtReceiver(axle, 1)


@ours
def test_each_axle_is_selected_by_its_own_bit(ours: Ours) -> None:
    for selected in range(1, 29):
        receivers = [ours(axle, ROOM) for axle in range(1, 29)]
        words = transmission(OTHER, [selected])
        kept = [receiver.axle for receiver in receivers if feed(receiver, words)]
        assert kept == [selected]


def test_a_mask_needs_an_axle() -> None:
    with pytest.raises(MtError, match="at least one axle"):
        mask_of([])


# -------------------------------------------------------------------------------------------- failed ones


def test_the_literal_receiver_empties_its_table() -> None:
    peer = literal.Receiver(1)
    for word in [*literal.send(TABLE, 1), *raw([1, 2], announced=1, total=9)]:
        peer.read(word)
    assert peer.table == []


@ours
def test_a_failed_transmission_leaves_the_table(ours: Ours) -> None:
    receiver = ours(1, ROOM)
    feed(receiver, transmission(TABLE, [1]))
    feed(receiver, raw([1, 2], announced=1, total=9))
    assert receiver.status is MtStatus.CHECKSUM_ERROR
    assert (receiver.pairs, receiver.generation, receiver.checksum) == (TABLE, 1, checksum(TABLE))


@ours
def test_an_empty_table_removes(ours: Ours) -> None:
    receiver = ours(1, ROOM)
    feed(receiver, transmission(TABLE, [1]))
    assert feed(receiver, transmission((), [1])) == 1
    assert (receiver.pairs, receiver.generation, receiver.checksum) == ((), 2, 0)

"""Our engines against the literal transcription, against each other, and against anything."""

from collections.abc import Sequence

from hypothesis import given
from hypothesis import strategies as st

from nodes.mt.mt import (
    C_CKHIGH,
    C_CKLOW,
    C_MASK,
    C_START,
    ESC,
    LIT,
    VALUES,
    MtStatus,
    Pair,
    digest,
    from_bytes,
    mask_of,
    to_bytes,
    to_frames,
    transmission,
)
from tests.nodes.mt import literal
from tests.nodes.mt.receiver import MtReceiver
from tests.nodes.mt.receivers import BOTH, FirmwareReceiver, feed

ROOM = 12
sent = st.one_of(
    st.integers(VALUES[0], VALUES[-1]), st.integers(-2, 2), st.sampled_from([VALUES[0], VALUES[-1]])
)
tables = st.lists(st.tuples(sent, sent), max_size=ROOM)
full_range = st.one_of(
    st.integers(-(1 << 31), (1 << 31) - 1),
    st.sampled_from([ESC - (1 << 32), LIT - (1 << 32), C_START | 1, C_MASK | 3, 0]),
)
full_tables = st.lists(st.tuples(full_range, full_range), max_size=ROOM)
axle_sets = st.sets(st.integers(1, 28), min_size=1)
words = st.one_of(
    st.sampled_from([ESC, LIT, C_MASK, C_MASK | 1, C_MASK | 3, C_CKHIGH, C_CKLOW | 6, C_CKLOW]),
    st.integers(0, 2 * ROOM).map(lambda n: C_START | n),
    st.integers(0, 4),
    st.integers(0, 0xFFFFFFFF),
)


@given(table=tables, axles=axle_sets, axle=st.integers(1, 28), only_changes=st.booleans())
def test_our_sender_reaches_the_literal_receiver(
    table: list[Pair], axles: set[int], axle: int, *, only_changes: bool
) -> None:
    peer, register = literal.Receiver(axle), literal.ChangedOnly()
    sending = transmission(table, axles)
    for word in register.pass_on(iter(sending)) if only_changes else sending:
        peer.read(word)
    assert peer.table_status == literal.STATUS_OK
    assert peer.table == (table if axle in axles else [])


@given(table=full_tables, axles=axle_sets, axle=st.integers(1, 28))
def test_the_literal_sender_reaches_our_receivers(table: list[Pair], axles: set[int], axle: int) -> None:
    for ours in BOTH:
        receiver = ours(axle, ROOM)
        kept = feed(receiver, literal.send(table, mask_of(axles)))
        assert kept == (axle in axles)
        assert receiver.pairs == (tuple(table) if axle in axles else ())
        assert receiver.status is MtStatus.OK


@given(table=tables, axles=axle_sets, only_changes=st.booleans())
def test_our_sender_reaches_our_receivers(table: list[Pair], axles: set[int], *, only_changes: bool) -> None:
    sending = transmission(table, axles)
    for ours in BOTH:
        receivers = [ours(axle, ROOM) for axle in range(1, 29)]
        for receiver in receivers:
            register = literal.ChangedOnly()
            feed(receiver, register.pass_on(iter(sending)) if only_changes else sending)
        assert [r.axle for r in receivers if r.generation] == sorted(axles)
        assert all(r.pairs == tuple(table) for r in receivers if r.generation)


@given(st.lists(words, max_size=120), st.integers(0, ROOM))
def test_both_of_ours_agree_on_anything(stream: list[int], room: int) -> None:
    python, firmware = MtReceiver(1, room), FirmwareReceiver(1, room)
    for word in stream:
        assert python.word(word) == firmware.word(word)
        assert (python.status, python.generation) == (firmware.status, firmware.generation)
    assert (python.pairs, python.checksum) == (firmware.pairs, firmware.checksum)
    assert python.digest == firmware.digest == digest(python.pairs)


@given(before=st.lists(words, max_size=60), table=tables, only_changes=st.booleans())
def test_a_transmission_arrives_after_anything(
    before: Sequence[int], table: list[Pair], *, only_changes: bool
) -> None:
    stream = [*before, *transmission(table, [1])]
    for ours in BOTH:
        receiver, register = ours(1, ROOM), literal.ChangedOnly()
        feed(receiver, register.pass_on(iter(stream)) if only_changes else stream)
        assert (receiver.status, receiver.pairs) == (MtStatus.OK, tuple(table))


@given(
    old=tables,
    new=st.lists(st.tuples(st.integers(1, 1 << 20), st.integers(1, 1 << 20)), min_size=1, max_size=ROOM),
    data=st.data(),
)
def test_what_is_kept_is_whole_whatever_was_lost(
    old: list[Pair], new: list[Pair], data: st.DataObject
) -> None:
    """With frames lost, a receiver has the old table or the new one, and its generation tells which.

    Values here are positive, so that no loss leaves both length and sum as they were.
    """
    frames = to_frames(transmission(new, [1]))
    lost = data.draw(st.sets(st.integers(0, len(frames) - 1)))
    for ours in BOTH:
        receiver = ours(1, ROOM)
        feed(receiver, transmission(old, [1]))
        for number, frame in enumerate(frames):
            if number not in lost:
                feed(receiver, from_bytes(frame))
        assert receiver.pairs == tuple(new if receiver.generation == 2 else old)
        if receiver.generation == 2:
            assert receiver.status is MtStatus.OK
        feed(receiver, transmission(new, [1]))
        assert (receiver.status, receiver.pairs) == (MtStatus.OK, tuple(new))


@given(tables)
def test_words_as_bytes_and_frames(table: list[Pair]) -> None:
    sending = transmission(table, [7])
    assert from_bytes(to_bytes(sending)) == sending
    assert from_bytes(b"".join(to_frames(sending))) == sending
    assert all(len(frame) == 8 for frame in to_frames(sending)[:-1])

"""The decoder of a bus: the recorded session, then all that can go wrong with one."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canbus_tools.protocol.decoded import Decoded, Kind
from canbus_tools.protocol.decoder import BusDecoder
from canbus_tools.protocol.dictionaries import LEARNT, DictionarySource
from canbus_tools.protocol.frame import Frame, FrameKind
from canbus_tools.protocol.protocol import Direction
from nodes.dictionary.dictionary import Dictionary
from tests import wire_twin as twin
from tests.canbus_tools import recorded
from tests.canbus_tools.talk_twin import (
    DICTIONARY,
    FROM,
    TO,
    Talk,
    decode,
    download,
    identify_pieces,
    texts,
)
from tests.profiles import examples


def knowing(*nodeids: int) -> BusDecoder:
    return BusDecoder(DictionarySource(dict.fromkeys(nodeids or (4,), DICTIONARY)))


# -------------------------------------------------------------------------------------- the recorded session


def check_session(said: list[Decoded], dictionary: Dictionary) -> None:
    expected = recorded.messages()
    assert len(said) == len(expected)
    for item, (direction, seq, name, params) in zip(said, expected, strict=True):
        assert (item.direction, item.seq) == (direction, seq)
        if name == "(ack/nak)":
            assert item.kind in (Kind.ACK, Kind.NAK)
            continue
        assert (item.kind, item.name) == (Kind.MESSAGE, name)
        assert item.params.keys() == params.keys()
        for param, value in item.params.items():
            wanted = params[param]
            if isinstance(wanted, str):
                names = dictionary.enumeration_for(param)
                assert names is not None
                assert names.value_of(wanted) == value
            else:
                assert (value & 0xFFFFFFFF if isinstance(value, int) else value) == wanted


@pytest.mark.parametrize("size", [8, 5, 1])
def test_the_recorded_session_is_read_completely(size: int) -> None:
    decoder = BusDecoder()
    said = decode(decoder, recorded.frames(size=size))
    check_session(said, decoder.dictionaries.known[recorded.NODEID])
    node = decoder.nodes[recorded.NODEID]
    assert (node.mcu, node.dictionary_origin) == ("linux", LEARNT)
    assert (node.to_node.bytes, node.from_node.bytes) == (2512, 10455)
    assert node.to_node.invalid_bytes == node.from_node.invalid_bytes == 0
    assert (node.flow.naks, node.flow.repeated_blocks, node.flow.missed_blocks) == (1, 0, 0)
    assert node.flow.round_trips.count == 177
    assert 20e-6 < node.flow.round_trips.min_s < 30e-6 < node.flow.round_trips.quantile_s(0.5) < 35e-6


# -------------------------------------------------------------------------------------------------- messages


def test_a_conversation() -> None:
    talk = Talk().command(5, "get_clock", "set_digital_out pin=PA1 value=1")
    talk.response(6, "clock", clock=0xFFFFFFFF).ack(6)
    talk.response(6, "shutdown", clock=7, static_string_id=2)
    decoder = knowing()
    said = decode(decoder, talk.frames)
    assert texts(said) == [
        "get_clock",
        "set_digital_out pin=PA1 value=1",
        "clock clock=4294967295",
        "ack next=6",
        'shutdown clock=7 static_string_id="Emergency stop"',
    ]
    assert [item.direction for item in said] == [TO, TO, FROM, FROM, FROM]
    assert said[2].params == {"clock": 0xFFFFFFFF}
    assert [item.seq for item in said] == [5, 5, 6, 6, 6]
    assert {item.nodeid for item in said} == {4}
    assert said[0].time_s == talk.frames[1].time_s  # when its block was whole
    node = decoder.nodes[4]
    assert (node.to_node.messages, node.from_node.messages) == (2, 2)
    assert node.flow.round_trips.count == 1
    assert node.flow.round_trips.max_s == pytest.approx(talk.frames[2].time_s - talk.frames[1].time_s)
    assert node.last_heard_s == talk.frames[-1].time_s


def test_debug_output_is_shown_without_what_a_terminal_obeys() -> None:
    content = DICTIONARY.outputs[0].format.encode({"_0": b"bed\x1b[2J", "_1": -5, "_2": 40})
    [said] = decode(knowing(), Talk().data(FROM, twin.block(1, content)).frames)
    assert said.name == "#output"
    assert said.params == {"text": b"heater bed\x1b[2J at -5 of 40%"}
    assert said.text == "#output 'heater bed\\x1b[2J at -5 of 40%'"


def test_what_no_dictionary_names_is_kept_as_bytes() -> None:
    talk = Talk().command(1, "get_clock").response(2, "clock", clock=5)
    decoder = BusDecoder()
    said = decode(decoder, talk.frames)
    assert [item.name for item in said] == ["unknown", "unknown"]
    assert said[1].params == {"content": DICTIONARY.responses["clock"].encode({"clock": 5})}
    assert decoder.nodes[4].to_node.unknown_messages == decoder.nodes[4].from_node.unknown_messages == 1


def test_commands_before_an_unknown_one_are_read() -> None:
    content = DICTIONARY.encode_text("get_clock") + b"\x5f\x01\x02"
    said = decode(knowing(), Talk().data(TO, twin.block(1, content)).frames)
    assert texts(said) == ["get_clock", "unknown content=5f 01 02"]


def test_several_nodes_at_once() -> None:
    one, two = Talk(4), Talk(255)
    one.command(1, "debug_ping data=0102030405060708090a").response(2, "pong", data=bytes(20))
    two.command(9, "debug_ping data=ffffffffffffffffffff").response(10, "pong", data=bytes(21))
    mixed = [frame for pair in zip(one.frames, two.frames, strict=False) for frame in pair]
    decoder = knowing(4, 255)
    said = decode(decoder, mixed + two.frames[len(one.frames) :])
    assert sorted((item.nodeid or 0, item.name) for item in said) == [
        (4, "debug_ping"), (4, "pong"), (255, "debug_ping"), (255, "pong"),
    ]  # fmt: skip
    assert set(decoder.nodes) == {4, 255}


# ---------------------------------------------------------------------------------------------- admin, others


def test_admin_and_signal_frames() -> None:
    uuid = bytes.fromhex("90a4ae022dfc")
    talk = (
        Talk()
        .frame(0x3F0, b"\x00")
        .frame(0x3F1, b"\x20" + uuid + b"\x11")
        .frame(0x3F0, b"\x01" + uuid + b"\x05")
    )
    talk.frame(0x3F0, b"\x41").frame(0x3F1, b"\x21" + uuid + b"\x05").frame(0x3F0, b"\x40\xff")
    talk.frame(0x010, b"\x03\x05\x21\x43\x65\x87").frame(0x023, b"\x03\x02\x78\x56\x34\x12").frame(
        0x3F0, b"\x02" + uuid
    )
    decoder = BusDecoder()
    said = decode(decoder, talk.frames)
    assert texts(said) == [
        "query_unassigned",
        "need_nodeid uuid=90a4ae022dfc set_command=bootloader",
        "set_nodeid uuid=90a4ae022dfc nodeid=5",
        "who_is_here",
        "node_is_here uuid=90a4ae022dfc nodeid=5",
        "sync_pulse seq=255",
        "bus_stop reason=3 origin=5 clock=2271560481",
        "trigger group=3 reason=2 clock=305419896",
        "request_bootloader uuid=90a4ae022dfc",
    ]
    assert [item.kind for item in said] == [Kind.ADMIN] * 6 + [Kind.SIGNAL] * 2 + [Kind.ADMIN]
    assert [item.nodeid for item in said] == [None, None, 5, None, 5, None, 5, None, None]
    assert decoder.nodes[5].uuid == "90a4ae022dfc"


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (Frame(1.0, 0x3F0, b""), "frame id=0x3f0 data="),
        (Frame(1.0, 0x3F0, b"\x01\x02"), "frame id=0x3f0 data=01 02"),
        (Frame(1.0, 0x3F0, b"\x77"), "frame id=0x3f0 data=77"),
        (Frame(1.0, 0x010, b"\x01"), "frame id=0x010 data=01"),
        (Frame(1.0, 0x100, b"\x01"), "frame id=0x100 data=01"),
        (Frame(1.0, 0x108, b"\x01", FrameKind.EXTENDED), "frame_extended id=0x00000108 data=01"),
        (Frame(1.0, 0x108, b"", FrameKind.REMOTE), "frame_remote id=0x108 data="),
        (Frame(1.0, 0x108, b"\x01", FrameKind.FD), "frame_fd id=0x108 data=01"),
    ],
)
def test_frames_of_other_protocols(frame: Frame, text: str) -> None:
    decoder = BusDecoder()
    [said] = decoder.feed(frame)
    assert (said.kind, said.text) == (Kind.OTHER, text)
    assert decoder.other_frames == 1


def test_error_frames_are_told_in_words() -> None:
    decoder = BusDecoder()
    data = bytes((0, 0x20, 0x84, 0, 0, 0, 128, 3))
    [said] = decoder.feed(Frame(1.0, 0x20C, data, FrameKind.ERROR))
    assert said.kind is Kind.ERROR
    assert said.text == (
        "error 0x20c [00 20 84 00 00 00 80 03] controller problem (error passive by transmit errors);"
        " protocol violation (bit stuffing, while transmitting); error counters;"
        " errors counted: 128 transmit, 3 receive"
    )
    assert decoder.error_frames == 1


# ------------------------------------------------------------------------------------------ loss and repeats


def test_a_lost_frame_costs_only_its_own_block() -> None:
    talk = Talk()
    for following in range(1, 6):
        talk.response(following, "pong", data=bytes(range(16 * following, 16 * following + 16)))
    whole = decode(knowing(), talk.frames)
    for lost in range(len(talk.frames)):
        decoder = knowing()
        said = decode(decoder, talk.frames[:lost] + talk.frames[lost + 1 :])
        messages = [item.params for item in said if item.kind is Kind.MESSAGE]
        assert messages == [item.params for i, item in enumerate(whole) if i != lost // 3]
        node = decoder.nodes[4].from_node
        assert (node.noises, [item.kind for item in said].count(Kind.NOISE)) == (1, 1)
        assert 14 <= node.invalid_bytes <= 16  # 15 or 16 bytes, of which the last may be a sync byte


def test_a_damaged_byte_costs_only_its_own_block() -> None:
    talk = Talk().command(1, "get_clock").command(2, "get_uptime").command(3, "get_clock")
    stream = b"".join(frame.data for frame in talk.frames)
    for at in range(6, 12):
        for bit in range(8):
            damaged = bytearray(stream)
            damaged[at] ^= 1 << bit
            said = decode(knowing(), Talk().data(TO, bytes(damaged)).frames)
            found = [item.name for item in said if item.kind is Kind.MESSAGE]
            assert found == ["get_clock", "get_clock"], (at, bit)


def test_a_block_cut_off_does_not_hold_the_next_one_back() -> None:
    talk = Talk().response(1, "pong", data=bytes(40))
    cut = talk.frames[:2]
    later = Talk(start_s=100.5).response(2, "clock", clock=1)
    decoder = knowing()
    said = [item for frame in cut + later.frames for item in decoder.feed(frame)]
    assert [item.kind for item in said] == [Kind.NOISE, Kind.MESSAGE]
    assert said[0].params["size"] == 16
    assert decoder.nodes[4].from_node.frames == len(cut + later.frames)


def test_a_pause_within_a_block_is_the_onlookers_own() -> None:
    """A machine that was busy reads the second half late: nothing is lost of it."""
    first, *rest = Talk().response(2, "clock", clock=0x5A5A5A5A).frames
    assert rest
    late = [frame._replace(time_s=frame.time_s + 0.4) for frame in rest]
    decoder = knowing()
    said = [item for frame in (first, *late) for item in decoder.feed(frame)]
    assert [(item.name, item.params) for item in said] == [("clock", {"clock": 0x5A5A5A5A})]


def test_sequence_numbers_wrap_without_a_miss() -> None:
    talk = Talk()
    for n in range(100):
        talk.command(n, "get_clock").response(n + 1, "clock", clock=n).ack(n + 1)
    decoder = knowing()
    said = decode(decoder, talk.frames)
    assert not any(item.repeated for item in said)
    flow = decoder.nodes[4].flow
    assert (flow.repeated_blocks, flow.missed_blocks, flow.naks, flow.round_trips.count) == (0, 0, 0, 100)


def test_repeats_naks_and_their_round_trips() -> None:
    talk = Talk().command(14, "get_clock").ack(15)
    talk.command(15, "get_clock").command(0, "get_uptime").command(1, "stepper_get_position oid=3")
    talk.ack(15)  # nak: 15 arrived damaged
    talk.command(15, "get_clock").command(0, "get_uptime").command(1, "stepper_get_position oid=3")
    talk.ack(0).ack(1).ack(2).ack(2)
    decoder = knowing()
    said = decode(decoder, talk.frames)
    assert [item.repeated for item in said if item.direction is TO] == [False] * 4 + [True] * 3
    assert [item.kind for item in said if item.direction is FROM] == [
        Kind.ACK, Kind.NAK, Kind.ACK, Kind.ACK, Kind.ACK, Kind.ACK,
    ]  # fmt: skip
    node = decoder.nodes[4]
    assert (node.flow.naks, node.flow.repeated_blocks, node.to_node.messages) == (1, 3, 4)
    # Of a repeated block nobody knows which one was answered.
    assert node.flow.round_trips.count == 1


def test_blocks_missing_from_a_recording_are_counted() -> None:
    talk = (
        Talk().command(3, "get_clock").ack(4).ack(7).command(7, "get_uptime").command(8, "get_clock").ack(9)
    )
    decoder = knowing()
    decode(decoder, talk.frames)
    assert (decoder.nodes[4].flow.missed_blocks, decoder.nodes[4].flow.naks) == (3, 0)


def test_a_host_that_comes_anew_leaves_nothing_out() -> None:
    talk = Talk().command(8, "get_clock").ack(9)
    talk.command(1, "get_uptime").ack(9).command(9, "get_uptime").ack(10)
    decoder = knowing()
    decode(decoder, talk.frames)
    assert (decoder.nodes[4].flow.missed_blocks, decoder.nodes[4].flow.naks) == (0, 1)


def test_a_node_that_was_reset_leaves_nothing_out() -> None:
    talk = Talk().command(8, "get_clock").ack(9)
    talk.command(1, "get_uptime").ack(0).command(0, "get_uptime").ack(1).command(1, "get_clock").ack(2)
    decoder = knowing()
    said = decode(decoder, talk.frames)
    assert decoder.nodes[4].flow.missed_blocks == 0
    assert not any(item.repeated for item in said)


def test_the_same_command_for_ever_is_no_repeat() -> None:
    talk = Talk(step_s=0.05)
    for n in range(64):
        talk.command(n, "get_clock")
    decoder = knowing()
    assert not any(item.repeated for item in decode(decoder, talk.frames))


def test_round_trips_without_usable_times_are_left_out() -> None:
    decoder = knowing()
    talk = Talk().command(1, "get_clock").ack(2)
    frames = [talk.frames[0], *(frame._replace(time_s=1.0) for frame in talk.frames[1:])]
    decode(decoder, frames)
    assert decoder.nodes[4].flow.round_trips.to_json() is None


# ---------------------------------------------------------------------------------------------------- hostile

any_frame = st.builds(
    Frame,
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([0x108, 0x109, 0x10A, 0x3F0, 0x3F1, 0x010, 0x022, 0x1FF]) | st.integers(0, 0x1FFFFFFF),
    st.binary(max_size=8) | st.binary(max_size=64),
    st.sampled_from([FrameKind.DATA] * 8 + list(FrameKind)),
)


@given(st.lists(any_frame, max_size=60))
def test_any_frames(frames: list[Frame]) -> None:
    decoder = knowing()
    for item in decode(decoder, frames):
        assert item.text
        assert item.text.isprintable()
        assert len(item.params) == len(item.values)
    for node in decoder.nodes.values():
        assert node.to_json()


@settings(max_examples=examples(60))
@given(st.randoms(use_true_random=False))
def test_a_mutated_session(rng: random.Random) -> None:
    talk = download(Talk(), identify_pieces())
    for n in range(40):
        talk.command(n, "get_clock", "queue_step oid=1 interval=100 count=2 add=-3").response(
            n + 1, "clock", clock=n
        )
    frames = list(talk.frames)
    for _ in range(rng.randint(1, 60)):
        at = rng.randrange(len(frames))
        match rng.randrange(5):
            case 0:
                del frames[at]
            case 1:
                frames.insert(at, frames[rng.randrange(len(frames))])
            case 2:
                frames[at] = frames[at]._replace(data=rng.randbytes(rng.randint(0, 8)))
            case 3:
                frames[at] = frames[at]._replace(can_id=rng.choice([0x108, 0x109, 0x10B, 0x3F0]))
            case _:
                frames[at] = frames[at]._replace(time_s=rng.choice([0.0, 1e9, -1.0, 100.0]))
    decoder = BusDecoder()
    said = decode(decoder, frames)
    assert all(item.text.isprintable() for item in said)
    for node in decoder.nodes.values():
        for way in (node.to_node, node.from_node):
            assert way.invalid_bytes <= way.bytes


def test_a_million_bytes_of_noise_leave_nothing_behind() -> None:
    rng = random.Random(1)
    decoder = BusDecoder()
    for n in range(20_000):
        decoder.feed(Frame(n * 1e-4, 0x109, rng.randbytes(8)))
    node = decoder.nodes[4]
    said = decoder.flush()
    assert node.from_node.bytes - node.from_node.invalid_bytes < 0.01 * node.from_node.bytes
    assert all(item.kind is Kind.NOISE for item in said)
    assert sum(len(str(item.params)) for item in said) < 1000


def test_directions_have_the_names_that_options_use() -> None:
    assert {d.value for d in Direction} == {"to", "from", "any"}

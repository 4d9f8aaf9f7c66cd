"""The socketcand protocol without sockets: every command, bad input, times, and any bytes in any pieces."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canbus_tools.inject.socketcand import COMMAND_MAX, HELD_MAX, JOBS_MAX, SETTLE_S, SocketcandSession
from nodes.transport.frame import CanFrame


def opened(mode: str = "bcmmode") -> SocketcandSession:
    session = SocketcandSession(("can0",))
    session.receive(f"< open can0 >< {mode} >".encode(), 0.0)
    assert session.output() == b"< hi >< ok >< ok >"
    return session


def answer(session: SocketcandSession, command: str, now_s: float = 10.0) -> str:
    session.receive(command.encode(), now_s)
    return session.output().decode()


def test_greets_opens_and_changes_modes() -> None:
    session = SocketcandSession(("can0", "can1"))
    assert session.output() == b"< hi >"
    assert answer(session, "< open can1 >") == "< ok >"
    assert session.mode.name == "BCM"
    assert answer(session, "< rawmode >") == "< ok >"
    assert session.mode.name == "RAW"
    assert answer(session, "<bcmmode>") == "< ok >"
    assert answer(session, "< echo >< echo >") == "< echo >< echo >"
    assert not session.closing


def test_a_bus_that_is_not_there_ends_the_connection() -> None:
    session = SocketcandSession(("can0", "can1"))
    session.output()
    assert (
        answer(session, "< open vcan0 >< rawmode >")
        == "< error there is no bus 'vcan0' here, only can0, can1 >"
    )
    assert session.closing
    assert answer(session, "< open can0 >") == ""


def test_sends_frames() -> None:
    session = opened("rawmode")
    assert answer(session, "< send 123 0 >< send 7ff 8 1 F1 00 ff 4 5 6 7 >\n< send 0 1 0a >") == ""
    assert session.frames_to_send() == [
        CanFrame(0x123),
        CanFrame(0x7FF, bytes.fromhex("01f100ff04050607")),
        CanFrame(0, b"\n"),
    ]
    assert session.frames_to_send() == []


def test_tells_frames_in_raw_mode_once_the_client_had_time_to_read_the_answer() -> None:
    session = opened("rawmode")
    first, second, third = CanFrame(0x12, b"\x01\xab"), CanFrame(0x7FF), CanFrame(0x13, bytes(8))
    session.receive_frame(first, 0.001, 1700000000.5)
    session.receive_frame(second, 0.002, 1.0)
    assert session.output() == b""
    assert session.next_deadline() == SETTLE_S
    session.handle_timer(SETTLE_S)
    assert session.output() == b"< frame 012 1700000000.500000 01AB >< frame 7FF 1.000000  >"
    session.receive_frame(third, SETTLE_S, 23.4242424)
    assert session.output() == b"< frame 013 23.424242 0000000000000000 >"


def test_what_is_held_back_is_bounded_and_stays_in_order() -> None:
    session = opened("rawmode")
    for number in range(HELD_MAX + 1):
        session.receive_frame(CanFrame(1, number.to_bytes(2)), 0.001, 1.0)
    told = [part.split()[3] for part in session.output().split(b"<")[1:]]
    assert told == [f"{number:04X}".encode() for number in range(HELD_MAX + 1)]


def test_hears_only_subscriptions_in_bcm_mode() -> None:
    session = opened()
    session.receive_frame(CanFrame(0x123, b"\1"), 10.0, 1.0)
    assert session.output() == b""
    assert answer(session, "< subscribe 0 0 123 >") == ""
    session.receive_frame(CanFrame(0x124, b"\1"), 10.0, 1.0)
    session.receive_frame(CanFrame(0x123, b"\1"), 10.0, 1.0)
    session.receive_frame(CanFrame(0x123, b"\1"), 10.0, 1.0)
    assert session.output() == b"< frame 123 1.000000 01 >" * 2
    assert answer(session, "< unsubscribe 123 >") == ""
    session.receive_frame(CanFrame(0x123, b"\1"), 10.0, 1.0)
    assert session.output() == b""


def test_an_interval_thins_out_and_the_latest_is_told_at_its_end() -> None:
    session = opened()
    answer(session, "< subscribe 1 500000 123 >")
    for number, now_s in enumerate((10.0, 10.5, 11.0)):
        session.receive_frame(CanFrame(0x123, bytes([number])), now_s, now_s)
    assert session.output() == b"< frame 123 10.000000 00 >"
    assert session.next_deadline() == 11.5
    session.handle_timer(11.49)
    assert session.output() == b""
    session.handle_timer(11.5)
    assert session.output() == b"< frame 123 11.000000 02 >"


def test_a_filter_tells_changes_under_its_mask() -> None:
    session = opened()
    answer(session, "< filter 0 0 123 2 0F 00 >")
    for data in ("1122", "2122", "2133", "2233", "22", "2234"):
        session.receive_frame(CanFrame(0x123, bytes.fromhex(data)), 10.0, 1.0)
    told = [part.split()[3] for part in session.output().decode().split("<")[1:]]
    assert told == ["1122", "2233", "22", "2234"]


def test_cyclic_frames_are_sent_updated_and_deleted() -> None:
    session = opened()
    assert answer(session, "< add 0 20000 123 2 42 43 >", 10.0) == ""
    assert session.frames_to_send() == [CanFrame(0x123, b"BC")]
    assert session.next_deadline() == pytest.approx(10.02)
    session.handle_timer(10.021)
    assert session.frames_to_send() == [CanFrame(0x123, b"BC")]
    assert session.next_deadline() == pytest.approx(10.04)
    assert answer(session, "< update 123 1 44 >") == ""
    session.handle_timer(10.105)  # late: sent once, and the beat goes on
    assert session.frames_to_send() == [CanFrame(0x123, b"D")]
    assert session.next_deadline() == pytest.approx(10.12)
    assert answer(session, "< delete 123 >") == ""
    assert session.next_deadline() == float("inf")


def test_raw_mode_ends_jobs_and_subscriptions() -> None:
    session = opened()
    answer(session, "< add 1 0 1 0 >< subscribe 0 0 5 >< rawmode >< bcmmode >")
    assert session.next_deadline() == float("inf")
    session.receive_frame(CanFrame(5), 10.0, 1.0)
    assert session.output() == b""


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("", "unknown command ''"),
        ("nonsense", "unknown command 'nonsense'"),
        ("isotpmode", "unknown command 'isotpmode'"),
        ("open can0", "open is no command of bcmmode"),
        ("echo echo", "echo takes no words"),
        ("rawmode now", "rawmode takes no words"),
        ("send 123", "send needs an id, a length and as many bytes"),
        ("send 800 0", "send: the id is 800, must be at most 7FF"),
        ("send 00000123 0", "send: this bus has only 11-bit ids, of at most three hexadecimal digits"),
        ("send 12x 0", "send: the id is '12x', must be a hexadecimal number"),
        ("send -1 0", "send: the id is '-1', must be a hexadecimal number"),
        ("send 123 9 1 2 3 4 5 6 7 8 9", "send: the length is 9, must be at most 8"),
        ("send 123 2 1", "send: the length is 2, and there are 1 bytes"),
        ("send 123 1 100", "send: a byte is 100, must be at most FF"),
        ("send 123 1 <", "send: a byte is '?', must be a hexadecimal number"),
        ("send 123 1 \xff", "send: a byte is '??', must be a hexadecimal number"),
        ("add 0 999 123 0", "add: an interval has at least 1000 microseconds"),
        ("add x 0 123 0", "add: seconds is 'x', must be a decimal number"),
        ("update 123 0", "update: no cyclic frame 123"),
        ("delete 5", "delete: no cyclic frame 005"),
        ("subscribe 0 0", "subscribe needs seconds, microseconds and an id"),
        ("subscribe 0 0 1 2", "subscribe needs one id"),
        ("unsubscribe 77", "unsubscribe: no subscription of 077"),
        ("x" * 300, "a command has at most 256 bytes"),
    ],
)
def test_bad_commands_get_a_sentence_and_are_counted(command: str, said: str) -> None:
    session = opened()
    assert answer(session, f"< {command} >< echo >") == f"< error {said} >< echo >"
    assert session.errors == 1
    assert session.frames_to_send() == []


def test_commands_of_bcm_mode_are_none_of_raw_mode() -> None:
    session = opened("rawmode")
    assert answer(session, "< subscribe 0 0 1 >") == "< error subscribe is no command of rawmode >"


def test_cyclic_frames_are_bounded() -> None:
    session = opened()
    for can_id in range(JOBS_MAX):
        assert answer(session, f"< add 1 0 {can_id:x} 0 >") == ""
    assert (
        answer(session, "< add 1 0 7FF 0 >") == f"< error add: there are {JOBS_MAX} cyclic frames already >"
    )
    assert answer(session, "< add 2 0 0 0 >") == ""


def test_what_never_becomes_a_command_is_not_kept() -> None:
    session = opened()
    assert answer(session, "no command " * 100) == ""
    assert answer(session, "<" + "a" * COMMAND_MAX) == "< error a command has at most 256 bytes >"
    assert answer(session, "a >< echo >") == "< echo >"


_NAMES = ["open can0", "rawmode", "bcmmode", "send", "add", "update", "delete", "subscribe", "filter", "echo"]
_WORDS = st.sampled_from([*_NAMES, "unsubscribe", "0", "1", "7", "8", "123", "FF", "1000"])
_COMMAND = st.lists(_WORDS, max_size=12).map(lambda words: f"< {' '.join(words)} >".encode())
_STREAM = st.lists(_COMMAND | st.binary(max_size=20), max_size=30).map(b"".join)


@given(stream=_STREAM, cuts=st.lists(st.integers(1, 50), min_size=1, max_size=20))
def test_any_bytes_in_any_pieces_are_answered_alike(stream: bytes, cuts: list[int]) -> None:
    whole, pieces = SocketcandSession(("can0",)), SocketcandSession(("can0",))
    start = b"< open can0 >"
    whole.receive(start + stream, 0.0)
    pieces.receive(start, 0.0)
    at = piece = 0
    while at < len(stream):
        size = cuts[piece % len(cuts)]
        pieces.receive(stream[at : at + size], 0.0)
        at, piece = at + size, piece + 1
    said = whole.output()
    assert pieces.output() == said
    assert pieces.frames_to_send() == whole.frames_to_send()
    assert pieces.errors == whole.errors == said.count(b"< error ")
    assert said.count(b"<") == said.count(b">")
    for session in (whole, pieces):
        session.receive_frame(CanFrame(0x123, b"\1"), 0.0, 1.0)
        session.handle_timer(1e6)
    assert pieces.output() == whole.output()

"""The decisions about what the protocol leaves open, one test for each, byte by byte."""

from typing import Any

import pytest

from coordinator.dnc.options import DncOptions, SerialFrame
from coordinator.dnc.protocol import events
from coordinator.dnc.protocol.blocks import (
    ACK,
    DIRECTORY_REQUEST,
    EOT,
    ETX,
    NAK,
    SOH,
    STX,
    BadText,
    Header,
    write_block,
)
from coordinator.dnc.protocol.engine import State
from nodes.support.errors import CanductorError
from tests.coordinator.dnc.bench import Bench, block, receiving, sending, take


@pytest.mark.parametrize("start_s", [0.0, 4294967.0, 1e9])
def test_a_repeat_is_on_nak_alone(start_s: float) -> None:
    bench = sending(start_s=start_s)
    assert bench.come(bytes([NAK]), 1.0) == block(b"X1")
    assert bench.wait(20.0) == bytes([EOT]), (
        "a time-out repeats nothing: a repeat after a lost ACK doubles a line"
    )
    assert "nothing was received after line 1" in bench.failure()


@pytest.mark.parametrize("transmissions", [1, 3, 15])
def test_so_many_transmissions(transmissions: int) -> None:
    bench = sending(transmissions=transmissions)
    for _ in range(transmissions - 1):
        assert bench.come(bytes([NAK]), 1.0) == block(b"X1")
    assert bench.come(bytes([NAK]), 1.0) == bytes([EOT])
    assert f"line 1 was refused {transmissions} times" in bench.failure()


@pytest.mark.parametrize("transmissions", [1, 3, 15])
def test_a_receiver_refuses_so_often(transmissions: int) -> None:
    bench = receiving(transmissions=transmissions)
    damaged = block(b"X1").replace(b"1", b"2")
    for _ in range(transmissions - 1):
        assert bench.come(damaged, 1.0) == bytes([NAK])
    assert bench.come(damaged, 1.0) == bytes([EOT])
    assert f"line 1 was received damaged {transmissions} times" in bench.failure()


@pytest.mark.parametrize(
    "check", [0x00, 0x01, 0x02, 0x03, 0x04, 0x06, 0x11, 0x13, 0x15, 0x17, 0x0D, 0x20, 0x7F]
)
def test_exactly_one_byte_behind_etb_is_the_check(check: int) -> None:
    """Whatever it is: also SOH, STX, ETX, EOT, ACK, DC1, DC3, NAK, ETB."""
    texts = (bytes([a, b]) for a in range(0x20, 0x7F) for b in range(0x20, 0x7F))
    text = next(t for t in texts if block(t, dc1=False)[-1] == check)
    for dc1 in (False, True):
        bench = receiving()
        bench.come(block(text, dc1=dc1))
        assert take(bench) == text


def test_one_dc1_or_none() -> None:
    bench = receiving()
    for dc1 in (True, False, True):
        bench.come(block(b"X1", dc1=dc1))
        assert take(bench) == b"X1"
        bench.wait(0.1)


def test_a_damaged_etb_ends_by_silence_and_is_refused() -> None:
    bench = receiving()
    assert bench.come(block(b"X1").replace(b"\x17", b"\x57"), 0.1) == b""
    assert bench.wait(0.3) == bytes([NAK])
    bench.wait(0.1)
    bench.come(block(b"X1"))
    assert take(bench) == b"X1"


@pytest.mark.parametrize("damaged", [b"\x03", b"B", b"\x00", b""])
def test_a_damaged_stx_is_refused(damaged: bytes) -> None:
    """Also one that became an ETX: the end of a file it is only with silence behind it."""
    bench = receiving(mode="E")
    assert bench.come(damaged + block(b"X1")[1:], 0.6) == bytes([NAK])
    assert bench.happened() == []


@pytest.mark.parametrize("at", range(1, 7))
def test_a_line_that_is_slow_within_a_block_is_refused_once(at: int) -> None:
    """Its rest is known by the check character; a second NAK would ask for two repeats, and double a line."""
    bench, whole = receiving(), block(b"X1")
    assert bench.come(whole[:at], 0.5) == bytes([NAK]), "it has no end"
    assert bench.come(whole[at:], 0.5) == b""
    bench.come(whole)
    assert take(bench) == b"X1"
    bench.wait(0.1)
    assert bench.come(block(b"X2" * 20)[:3], 0.5) == bytes([NAK])
    assert bench.come(block(b"X2" * 20)[3:].replace(b"X2", b"X3", 1), 0.6) == bytes([NAK])
    bench.come(block(b"X2" * 20))
    assert take(bench) == b"X2" * 20


def test_an_etb_too_early_is_none() -> None:
    """A 7 with one bit flipped is an ETB; by bad luck the next character is right as its check."""
    whole = b"\x02" + b"A7"
    check = write_block(STX, b"A")[-1]
    assert check == 0x54
    bench = receiving()
    good = write_block(STX, b"A7" + bytes([check]) + b"BC\r\n", dc1=True)
    assert good.startswith(whole)
    assert bench.come(good.replace(b"7", b"\x17", 1), 0.6) == bytes([NAK])
    assert bench.happened() == []


def test_a_lone_etx_between_blocks_is_noise() -> None:
    bench = receiving(mode="E")
    bench.come(bytes([ETX]), 0.05)
    bench.come(block(b"X1"))
    assert take(bench) == b"X1"
    bench.wait(0.05)
    assert bench.come(bytes([ETX]), 0.5) == b""
    assert bench.happened() == [events.Ended()]
    bench.engine.file_kept()
    assert bench.said() == bytes([EOT])


def test_no_end_comes_after_nak() -> None:
    bench = receiving(mode="E")
    assert bench.come(block(b"X1").replace(b"1", b"2"), 0.6) == bytes([NAK])
    bench.come(bytes([ETX]), 0.6)
    assert bench.happened() == []


def test_output_ends_with_etx_eot_together() -> None:
    bench = receiving()
    bench.come(bytes([ETX]), 1.0)
    assert bench.happened() == [], "an ETX by itself is noise"
    bench.come(bytes([ETX]), 0.1)
    bench.come(bytes([EOT]), 1.0)
    assert "ended the transfer" in bench.failure(), "an EOT later gives up"
    bench = receiving()
    bench.come(bytes([ETX, EOT]))
    assert bench.happened() == [events.Ended()]


def test_nak_counts_only_alone() -> None:
    """To repeat what was taken would double a line: an answer that follows NAK makes both doubtful."""
    bench = sending()
    bench.come(bytes([NAK]), 0.1)
    assert bench.come(bytes([ACK]), 0.1) == bytes([EOT])
    assert "two different answers" in bench.failure()


def test_nak_after_an_ack_in_noise() -> None:
    bench = sending()
    bench.come(b"\x87" + bytes([ACK]), 0.5)
    assert bench.come(bytes([NAK]), 0.5) == bytes([EOT])
    assert "may have been its ACK" in bench.failure()


def test_an_answer_before_its_block_has_left_is_none() -> None:
    bench = sending(paced=True)
    bench.come(bytes([ACK]))
    bench.engine.give_line(b"X" * 100)
    bench.said()
    assert bench.come(bytes([ACK]), 0.02) == bytes([EOT])
    assert "before its block was sent" in bench.happened()[-1].sentence  # type: ignore[union-attr]


def test_the_same_line_again_after_nak_cannot_be_told_from_a_repeat() -> None:
    bench = receiving()
    bench.come(block(b"X1"))
    take(bench)
    bench.wait(0.1)
    assert bench.come(b"noise\x17noise", 0.5) == bytes([NAK])
    bench.wait(0.1)
    assert bench.come(block(b"X1"), 0.1) == bytes([EOT])
    assert "was received again" in bench.failure()


def test_equal_lines_are_two_lines() -> None:
    bench = receiving()
    for _ in range(3):
        bench.come(block(b"X1"))
        assert take(bench) == b"X1"
        bench.wait(0.1)


def test_a_block_before_the_last_was_answered() -> None:
    bench = receiving()
    bench.come(block(b"X1").replace(b"1", b"2"), 0.05)
    assert bench.come(block(b"X2"), 0.5) == bytes([EOT])
    assert "before the last one was answered" in bench.failure()


def test_two_blocks_at_once_end_the_transfer() -> None:
    """Also for an owner that hears of it late: what it can no longer answer it is not told."""
    bench = receiving()
    assert bench.come(block(b"X1") + block(b"X2"), 0.0) == bytes([EOT])
    assert "the two sides are out of step" in bench.failure()


def test_an_idle_control_answers_nothing() -> None:
    bench = Bench(peripheral=False)
    for data in (write_block(SOH, b"DPARTA"), block(b"X1"), DIRECTORY_REQUEST, b"\x06", b"\x15", b"\x04"):
        assert bench.come(data, 1.0) == b""
    assert bench.happened() == []


@pytest.mark.parametrize("text", [b"A\tB", b"\x1b[", b"\x7f", b"A\x00"])
def test_control_characters_are_refused_when_sent(text: bytes) -> None:
    bench = sending()
    bench.come(bytes([ACK]))
    with pytest.raises(BadText, match="line 2 has the control character"):
        bench.engine.give_line(text)
    assert bench.said() == b""


def test_control_characters_are_refused_when_received() -> None:
    bench = receiving()
    bad = write_block(STX, b"A\tB\r\n", dc1=True)
    assert bench.come(bad, 0.5) == bytes([NAK])


def test_long_lines() -> None:
    bench = receiving(block_max=20)
    bench.come(block(b"X" * 18))
    assert take(bench) == b"X" * 18
    bench.wait(0.1)
    assert bench.come(block(b"X" * 19 + b"1234"), 0.6) == bytes([NAK])
    sender = sending(block_max=20)
    sender.come(bytes([ACK]))
    with pytest.raises(BadText, match="line 2 has 19 characters"):
        sender.engine.give_line(b"X" * 19)


def test_a_peripheral_tells_an_error() -> None:
    control, peripheral = Bench(peripheral=False), Bench(peripheral=True)
    control.engine.fetch("H", "NOT")
    peripheral.come(control.said())
    assert peripheral.happened() == [events.Asked(Header("H", "NOT", "E"))]
    peripheral.engine.refuse("NO SUCH FILE")
    error = peripheral.said()
    assert error.startswith(b"\x01NO SUCH FILE\x17")
    control.wait(0.1)
    assert control.come(error) == bytes([ACK, EOT])
    assert control.failure() == "the peripheral reports: NO SUCH FILE"
    peripheral.wait(0.05)
    assert peripheral.come(bytes([ACK, EOT])) == b""
    assert "an error was reported" in peripheral.failure()
    assert peripheral.engine.state is State.IDLE


def test_the_control_begins_anew() -> None:
    bench = receiving()
    bench.come(block(b"X1"))
    take(bench)
    bench.come(write_block(SOH, b"DOTHERA", dc1=True))
    failed, asked = bench.happened()
    assert isinstance(failed, events.Failed)
    assert asked == events.Asked(Header("D", "OTHER", "A"))


def test_a_pause_by_dc3() -> None:
    bench = sending(decide_s=100.0)
    bench.come(b"\x13", 0.5)
    bench.come(bytes([ACK]), 20.0)
    assert bench.happened() == []
    bench.come(b"\x11")
    assert bench.happened() == [events.LineWanted()]


def test_a_line_is_wanted_once() -> None:
    """Whatever pauses are asked for before it is given."""
    bench = sending()
    bench.come(bytes([ACK]))
    bench.come(b"\x13")
    assert bench.engine.held
    bench.come(b"\x11")
    assert not bench.engine.held
    assert bench.happened() == [events.LineWanted()]
    bench.engine.give_line(b"X2")
    assert bench.said() == block(b"X2")


def test_noise_without_end_does_not_keep_a_transfer_alive() -> None:
    bench = receiving()
    for _ in range(200):
        if bench.come(b"\x87", 0.1) == bytes([EOT]):
            break
    else:
        pytest.fail("it waited for ever")


def test_flow_control_is_the_answer_withheld() -> None:
    bench = receiving()
    bench.come(block(b"X1"))
    assert bench.wait(3600.0) == b""
    assert take(bench) == b"X1"


@pytest.mark.parametrize(
    "wrong",
    [{"baud": 1}, {"transmissions": 0}, {"block_max": 1}, {"character_s": 0.0}],
)
def test_options_are_checked(wrong: dict[str, Any]) -> None:
    with pytest.raises(CanductorError, match=next(iter(wrong))):
        DncOptions(**wrong)


def test_patience_is_longer_than_silence() -> None:
    with pytest.raises(
        CanductorError, match=r"the timeout of an answer is 0\.2 s, must be longer than the silence"
    ):
        DncOptions(answer_s=0.2)


def test_frames_have_their_times() -> None:
    assert [SerialFrame(*f).bits for f in ((7, "E", 1), (8, "N", 1), (8, "E", 2))] == [10, 10, 12]

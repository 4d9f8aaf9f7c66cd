"""The line protocol of serial hosts, by what they send."""

import pytest

from coordinator.serial_host.protocol import (
    LINE_BYTES_MAX,
    OUTPUT_BYTES_MAX,
    WAITING_BYTES_MAX,
    SerialProtocol,
)
from tests.coordinator.serial_host.framing import numbered


def lines(protocol: SerialProtocol) -> list[tuple[str, str]]:
    """Return command and text, or the refusal, of what waits."""
    found = []
    while (line := protocol.next_line()) is not None:
        found.append(("refused", line.refusal) if line.refusal else (line.name, line.text))
    return found


def test_numbers_and_checksums_are_taken_off_and_checked() -> None:
    protocol = SerialProtocol()
    assert not protocol.receive(numbered(0, "M110 N0") + numbered(1, "M115") + b"\r\n; note\nG1 X1 ; go\r\n")
    assert lines(protocol) == [
        ("M110", "M110 N0"),
        ("M115", "M115"),
        ("", ""),
        ("", ""),
        ("G1", "G1 X1 ; go"),
    ]
    protocol.receive(numbered(2, "G1 X2").replace(b"X2", b"X9"))
    protocol.receive(numbered(3, "G1 X3"))
    protocol.receive(numbered(2, "G1 X2"))
    protocol.receive(numbered(2, "G1 X2"))
    protocol.receive(numbered(3, "G1 X3") + b"N4 G1 X4\n")
    assert lines(protocol) == [
        ("refused", "Resend: 2"),
        ("refused", "Resend: 2"),
        ("G1", "G1 X2"),
        ("refused", "Resend: 3"),
        ("G1", "G1 X3"),
        ("G1", "G1 X4"),
    ]


def test_m110_sets_the_number() -> None:
    protocol = SerialProtocol()
    protocol.receive(
        numbered(7, "G28") + numbered(-1, "M110") + numbered(0, "M105") + b"N9 M110 N41\nN42 G28\n"
    )
    assert [name for name, _ in lines(protocol)] == ["G28", "M110", "M105", "M110", "G28"], (
        "any number begins"
    )
    protocol.receive(b"N1 M105*0\n")
    assert lines(protocol) == [("refused", "Resend: 43")]


@pytest.mark.parametrize(
    "stop", [b"M112\n", b"n5 m112*3\r\n", b" M112 ; now\n", b"N-1M112\n", b"m0112\n", numbered(3, "M112")]
)
def test_a_stop_overtakes_what_waits(stop: bytes) -> None:
    protocol = SerialProtocol()
    protocol.receive(b"G28\n" * 1000)
    assert not protocol.stops_with(stop[:-1])
    assert protocol.stops_with(stop)
    for at in range(len(stop) - 1):
        assert not protocol.receive(stop[at : at + 1])
    assert protocol.stops_with(b"\n")
    assert protocol.receive(stop[-1:] + b"M105\n")
    assert lines(protocol) == [("", ""), ("M105", "M105")], "what came before it is forgotten"


def test_after_a_stop_without_a_number_any_number_begins() -> None:
    protocol = SerialProtocol()
    protocol.receive(numbered(7, "G28"))
    assert lines(protocol) == [("G28", "G28")]
    assert protocol.receive(numbered(8, "G1 X1") + b"M112\n" + numbered(9, "M105"))
    assert lines(protocol) == [("", ""), ("M105", "M105")]


@pytest.mark.parametrize(
    "line", [b"M1120\n", b"M112.1\n", b"M117 M112\n", b";M112\n", b"ECHO M112\n", b"M11\n2\n"]
)
def test_what_is_no_stop(line: bytes) -> None:
    protocol = SerialProtocol()
    assert not protocol.stops_with(line)
    assert not protocol.receive(line)


def test_what_comes_is_bounded() -> None:
    protocol = SerialProtocol()
    for _ in range(300):
        protocol.receive(b"x" * 1000)
    assert len(protocol._rest) <= LINE_BYTES_MAX
    protocol.receive(b"M112\nM105\n")
    found = lines(protocol)
    assert [name for name, _ in found] == ["refused", "M105"], "one answer for each line"
    assert f"!! a line has more than {LINE_BYTES_MAX} bytes" in found[0]
    count = 0
    while not protocol.full:
        protocol.receive(b"\n" * 100)
        count += 100
    assert count <= WAITING_BYTES_MAX // 50
    while protocol.full:
        assert protocol.next_line() is not None
    protocol.receive(b"\x00\xff\x1b[2J\n")
    *_, (name, text) = lines(protocol)
    assert (name, text) == ("", "\x00\ufffd\x1b[2J"), "what nobody can read is no bug"


def test_output_is_printable_and_of_a_host_that_does_not_read_bounded() -> None:
    protocol = SerialProtocol()
    protocol.say("// a\x1b[2J\tb\nsecond")
    protocol.answer("T0:20.0 /0.0")
    protocol.answer()
    assert protocol.output == b"// a?[2J\tb\nsecond\nok T0:20.0 /0.0\nok\n"
    protocol.sent(11)
    assert protocol.output == b"second\nok T0:20.0 /0.0\nok\n"
    while not protocol.overflowed:
        protocol.say("x" * 99)
        assert len(protocol.output) <= OUTPUT_BYTES_MAX
    assert protocol.output == b"x" * 99 + b"\n", "what is left begins with a line"

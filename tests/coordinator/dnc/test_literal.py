"""Against the manual's page, transcribed: both roles, both directions, with damage that it can cope with."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.dnc.options import DncOptions, read_frame
from coordinator.dnc.protocol import events
from coordinator.dnc.protocol.blocks import SOH, STX, Header, block_check, write_block
from coordinator.dnc.protocol.engine import Engine
from coordinator.dnc.protocol.lexer import Lexer
from coordinator.dnc.protocol.tokens import Kind
from tests.coordinator.dnc import literal
from tests.coordinator.dnc.line import Faults, Line, Owner, Wire
from tests.profiles import examples

texts = st.binary(max_size=60).map(lambda t: bytes(c for c in t if 0x20 <= c < 0x7F))
programs = st.lists(texts, max_size=12)
quick = settings(max_examples=examples(40))


class TextWire(Wire):
    """Flips one bit of one letter in some blocks: what the page's receiver can find."""

    share = 0.0

    def send(self, data: bytes, now_s: float) -> list[tuple[float, bytes]]:
        letters = [i for i, c in enumerate(data) if 0x40 <= c < 0x60 and 0 < i < len(data) - 3]
        if letters and self.chance.random() < self.share:
            at = self.chance.choice(letters)
            data = data[:at] + bytes([data[at] ^ 1 << self.chance.randrange(5)]) + data[at + 1 :]
        return super().send(data, now_s)


def line_between(control: object, peripheral: object, options: DncOptions, share: float, seed: int) -> Line:
    wires = tuple(TextWire(Faults(), options, random.Random(seed + i)) for i in range(2))
    for wire in wires:
        wire.share = share
    return Line((control, peripheral), wires, random.Random(seed))  # type: ignore[arg-type]


def options_of(dc1: bool, avoid: bool, frame: str) -> DncOptions:
    return DncOptions(frame=read_frame(frame), dc1=dc1, avoid_control=avoid, paced=True)


cases = {
    "program": programs,
    "dc1": st.booleans(),
    "avoid": st.booleans(),
    "frame": st.sampled_from(["7E1", "8N1"]),
    "share": st.sampled_from([0.0, 0.3]),
    "seed": st.integers(0, 10_000),
}


@quick
@given(st.sampled_from([SOH, STX]), texts, st.booleans())
def test_blocks_are_the_same(first: int, text: bytes, dc1: bool) -> None:
    ours = write_block(first, text, dc1=dc1)
    assert ours == literal.block(first, text, dc1=dc1)
    assert block_check(text) == literal.bcc(text)
    lexer = Lexer(DncOptions())
    tokens = lexer.receive(ours, 1.0) + lexer.handle_timer(2.0)
    assert [(s.kind, s.content) for s in tokens] == [(Kind.HEADER if first == SOH else Kind.BLOCK, text)]


@quick
@given(**cases)
def test_our_control_sends_to_the_page(
    *, program: list[bytes], dc1: bool, avoid: bool, frame: str, share: float, seed: int
) -> None:
    options = options_of(dc1, avoid, frame)
    headers: list[bytes] = []
    lines: list[bytes] = []
    control = Owner(Engine(options, 0.0, peripheral=False), program)
    control.engine.send("L", "PPP")
    line_between(
        control, literal.LiteralEnd(literal.peripheral_output(headers, lines)), options, share, seed
    ).run()
    if control.outcome == events.Sent(confirmed=False):
        assert [h.rstrip(b" ") for h in headers] == [b"LPPPA"]
        assert [t.removesuffix(b" ") if t.endswith(b"\n ") else t for t in lines] == [
            t + b"\r\n" for t in program
        ]
        assert all(block_check(b"\x02" + t + b"\x17") >= 0x20 for t in lines) or not avoid
    else:
        assert share
        assert isinstance(control.outcome, events.Failed)


@quick
@given(**cases)
def test_the_page_sends_to_our_peripheral(
    *, program: list[bytes], dc1: bool, avoid: bool, frame: str, share: float, seed: int
) -> None:
    options = options_of(dc1, avoid, frame)
    peripheral = Owner(Engine(options, 0.0, peripheral=True), None)
    talk = literal.control_output(b"LPPPA", [t + b"\r\n" for t in program], dc1=dc1)
    line_between(literal.LiteralEnd(talk), peripheral, options, share, seed).run()
    if peripheral.kept is not None:
        assert peripheral.kept == program
        assert peripheral.header == Header("L", "PPP", "A")
    else:
        assert share
        assert isinstance(peripheral.outcome, events.Failed)


@quick
@given(**cases)
def test_our_control_fetches_from_the_page(
    *, program: list[bytes], dc1: bool, avoid: bool, frame: str, share: float, seed: int
) -> None:
    options = options_of(dc1, avoid, frame)
    headers: list[bytes] = []
    control = Owner(Engine(options, 0.0, peripheral=False), None)
    control.engine.fetch("H", "15")
    talk = literal.peripheral_input(headers, [t + b"\r\n" for t in program], dc1=dc1)
    page = literal.LiteralEnd(talk)
    line_between(control, page, options, share, seed).run()
    if control.kept is not None:
        assert control.kept == program
        assert [h.rstrip(b" ") for h in headers] == [b"H15E"]
        assert page.is_over
    else:
        assert share
        assert isinstance(control.outcome, events.Failed)


@quick
@given(**cases)
def test_the_page_fetches_from_our_peripheral(
    *, program: list[bytes], dc1: bool, avoid: bool, frame: str, share: float, seed: int
) -> None:
    options = options_of(dc1, avoid, frame)
    lines: list[bytes] = []
    peripheral = Owner(Engine(options, 0.0, peripheral=True), program)
    page = literal.LiteralEnd(literal.control_input(b"H15E", lines, dc1=dc1))
    line_between(page, peripheral, options, share, seed).run()
    if isinstance(peripheral.outcome, events.Sent):
        assert peripheral.outcome.confirmed
        assert [t.removesuffix(b" ") if t.endswith(b"\n ") else t for t in lines] == [
            t + b"\r\n" for t in program
        ]
    else:
        assert share
        assert isinstance(peripheral.outcome, events.Failed)


@pytest.mark.parametrize("role", ["control", "peripheral"])
def test_the_page_s_example(role: str) -> None:
    """The 10th line is refused once and sent again."""
    program = [f"line {i}".encode() for i in range(1, 13)]
    options = DncOptions(paced=True)
    lines: list[bytes] = []
    control = Owner(Engine(options, 0.0, peripheral=False), program)
    control.engine.send("L", "PPP")
    ours = Owner(Engine(options, 0.0, peripheral=True), None)
    if role == "control":
        line = line_between(control, literal.LiteralEnd(literal.peripheral_output([], lines)), options, 0, 1)
    else:
        talk = literal.control_output(b"LPPPA", [t + b"\r\n" for t in program], dc1=True)
        line = line_between(literal.LiteralEnd(talk), ours, options, 0, 1)

    class Once(Wire):
        left = 1

        def send(self, data: bytes, now_s: float) -> list[tuple[float, bytes]]:
            if b"line 10" in data and self.left:
                self.left = 0
                data = data.replace(b"line 10", b"lyne 10")
            return super().send(data, now_s)

    damaging = Once(Faults(), options, random.Random(1))
    line.wires = (line.wires[0], damaging)
    line.run()
    assert damaging.left == 0
    text = "\n".join(entry for _, entry in line.wires[0].log)
    assert text.count(repr(b"\x15")) == 2, "one NAK, shown as sent and as arrived"
    assert (lines == [t + b"\r\n" for t in program]) if role == "control" else (ours.kept == program)

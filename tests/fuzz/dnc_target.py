"""What the fuzzers of BCC run: any bytes for either role, in any pieces, at any times."""

from coordinator.dnc.options import DncOptions, read_frame
from coordinator.dnc.protocol import events
from coordinator.dnc.protocol.blocks import DIRECTORY_REQUEST, SOH, STX, BadText, write_block
from coordinator.dnc.protocol.engine import DIRECTORY_MAX, Engine, State

OPTIONS = tuple(
    DncOptions(
        frame=read_frame(frame), dc1=dc1, avoid_control=not dc1, paced=paced, block_max=100, transmissions=4
    )
    for frame, dc1, paced in (("7E1", True, False), ("8N1", False, True), ("8N1", True, True))
)
PIECES = (
    write_block(SOH, b"DPARTA", dc1=True),
    write_block(SOH, b"H15E"),
    write_block(SOH, b"DE", dc1=True),
    write_block(STX, b"N1 G1 X1\r\n", dc1=True),
    write_block(STX, b"\r\n", avoid_control=True),
    write_block(STX, b"7" * 98 + b"\r\n"),
    DIRECTORY_REQUEST,
    b"\x06",
    b"\x15",
    b"\x03",
    b"\x03\x04",
    b"\x04",
    b"\x13",
    b"\x11",
    b"\x06\x04",
    b"\x00",
)
LINES = (b"X1", b"", b"Y" * 98, b"bad\x07", b"Z" * 99)


def run_engine(data: bytes, choice: int) -> None:
    """Feed DATA in pieces and pauses that CHOICE decides; nothing raises, all bounds hold, patience ends."""
    options = OPTIONS[choice % len(OPTIONS)]
    engine = Engine(options, 0.0, peripheral=bool(choice & 0x40))
    now_s, position, taken = 0.0, 0, 0
    lines: list[bytes] = []
    if not engine.is_peripheral:
        (engine.fetch, engine.send)[choice >> 7 & 1](
            "D", "PART"
        ) if choice & 0x600 else engine.ask_directory()
    while position < len(data):
        choice = (choice * 1103515245 + 12345) & 0x7FFFFFFF
        piece = data[position : position + 1 + (choice >> 8) % 40]
        position += len(piece)
        now_s += (0.0, 0.001, 0.01, 0.3, 0.5, 9.0, 40.0)[(choice >> 16) % 7]
        engine.handle_timer(now_s)
        now_s += len(piece) * options.character_time_s
        engine.receive(piece, now_s)
        _own(engine, lines, choice)
        output = engine.take_output()
        taken += len(output)
        assert taken <= 400 + 110 * position, "more is said than is asked"
        assert len(engine._lexer._data) <= options.block_max + 4
        assert len(engine._listing) <= DIRECTORY_MAX + 1
        deadline_s = engine.next_deadline()
        assert deadline_s is None or deadline_s < now_s + 700
    for _ in range(400):  # silence from now on: whatever was on comes to its end
        _own(engine, lines, 0)
        engine.take_output()
        deadline_s = engine.next_deadline()
        if deadline_s is None:
            break
        now_s = max(now_s, deadline_s)
        engine.handle_timer(now_s)
    assert engine.state is State.IDLE


def _own(engine: Engine, lines: list[bytes], choice: int) -> None:
    """Act as an owner may."""
    for _ in range(100):
        happened = engine.take_events()
        if not happened:
            return
        for event in happened:
            match event:
                case events.Asked():
                    lines.clear()
                    engine.accept() if choice & 0x3000 else engine.refuse("NO\x07 SUCH FILE" * 9)
                case events.DirectoryAsked():
                    engine.give_directory(b"\r\n" * 4)
                case events.LineWanted():
                    _give(engine, choice)
                case events.Line(text=text):
                    assert len(text) <= engine.options.block_max
                    assert not any(c < 0x20 and c not in b"\r\n" for c in text)
                    lines.append(text)
                    engine.line_taken()
                case events.Ended():
                    assert engine.lines == len(lines)
                    engine.file_kept()
                case events.Failed(sentence=sentence):
                    assert sentence
                    assert "\n" not in sentence
    raise AssertionError("events without end")


def _give(engine: Engine, choice: int) -> None:
    if choice & 0x70000 == 0:
        engine.give_end()
        return
    try:
        engine.give_line(LINES[(choice >> 20) % len(LINES)])
    except BadText as error:
        engine.refuse("BAD LINE") if engine.is_peripheral else engine.fail(str(error))

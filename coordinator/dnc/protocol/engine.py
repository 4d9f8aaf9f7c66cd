"""The transfer protocol of one line, as the control or as the peripheral. Sans-IO.

A block is repeated only on NAK: blocks have no number, so a repeat after a missing answer would double a line
whenever the answer was lost. A side that misses an answer sends EOT and fails.

    control  fetch:      SOH K name E →   ← ACK, blocks, each ACK →   ← ETX   EOT →
    control  send:       SOH K name A →   ← ACK   blocks →, each ← ACK   ETX EOT →
    control  directory:  DC3 ESC DC1 0 SP D CR LF →   ← lines of text, ETX   EOT →
    error of a peripheral: ← SOH text ETB BCC   ACK EOT →

The owner passes in bytes and time, sends the bytes of ``take_output``, and handles the events of
``take_events``. Times are seconds of a monotonic clock.
"""

from collections.abc import Callable
from enum import Enum
from typing import ClassVar, Final

from coordinator.dnc.options import DncOptions
from coordinator.dnc.protocol import events
from coordinator.dnc.protocol.blocks import (
    ACK,
    CRLF,
    DIRECTORY_REQUEST,
    EOT,
    ETX,
    INPUT,
    NAK,
    OUTPUT,
    SOH,
    STX,
    BadText,
    Header,
    is_text,
    read_header,
    strip_text,
    write_block,
)
from coordinator.dnc.protocol.lexer import Lexer
from coordinator.dnc.protocol.tokens import Kind, Token
from nodes.support.terminal import printable

DIRECTORY_MAX: Final = 262_144
"""Bytes of a directory."""

ERROR_TEXT_MAX: Final = 32
"""Characters of an error's text; old controls display no more."""


class State(Enum):
    """What the engine waits for."""

    IDLE = "nothing; a peripheral: for a header"
    ASKED = "the owner to accept or refuse"
    HEADER_SENT = "the answer to a header"
    LINE_WANTED = "a line from the owner"
    BLOCK_SENT = "the answer to a block"
    ETX_SENT = "EOT, after the last block of an input"
    RECEIVING = "a block"
    LINE_GIVEN = "the owner to take a line"
    END_GIVEN = "the owner to keep the file"
    ERROR_SENT = "the answer to an error"
    LISTING = "the directory"


_TRANSFER: Final = frozenset(State) - {State.IDLE, State.ASKED, State.ERROR_SENT, State.LISTING}
_QUIET: Final = (Kind.NOISE, Kind.HOLD, Kind.GO_ON)
_IGNORED: Final = frozenset((kind, state) for kind in _QUIET for state in State) | {
    # Answers that result from noise are harmless where blocks are expected.
    *(
        (kind, state)
        for kind in (Kind.ACK, Kind.NAK, Kind.CONFLICT, Kind.DIRECTORY)
        for state in (State.RECEIVING, State.LINE_GIVEN, State.END_GIVEN)
    ),
    # Block-like data is noise where answers are expected.
    *(
        (kind, state)
        for kind in (Kind.DAMAGED, Kind.ETX, Kind.DIRECTORY)
        for state in (State.BLOCK_SENT, State.HEADER_SENT, State.LINE_WANTED, State.ETX_SENT)
    ),
}
_SHOWN: Final = {
    Kind.BLOCK: "a block",
    Kind.HEADER: "a header",
    Kind.END: "ETX EOT",
    Kind.DIRECTORY: "a request for the directory",
    Kind.DAMAGED: "something damaged",
    Kind.OVERRUN: "a block before the last one was answered",
    Kind.CONFLICT: "two different answers to one block",
    Kind.NOISE: "noise",
    Kind.HOLD: "DC3",
    Kind.GO_ON: "DC1",
} | {kind: kind.name for kind in (Kind.ACK, Kind.NAK, Kind.ETX, Kind.EOT)}


class Engine:
    """One end of a line."""

    def __init__(self, options: DncOptions, now_s: float, *, peripheral: bool) -> None:
        self.options = options
        self.state = State.IDLE
        self.header: Header | None = None
        """Of the current transfer, or the last one."""
        self.lines = 0
        """Of that transfer, acknowledged."""
        self.repeats = 0
        """Blocks sent or requested again since the engine was created."""
        self.is_peripheral = peripheral
        self._lexer = Lexer(options)
        self._now_s = now_s
        self._output = bytearray()
        self._events: list[events.Event] = []
        self._sent = b""
        self._tries = 0
        self._left_s = now_s
        """When the last character of the block before DC1 can have left, at the earliest."""
        self._busy_until_s = now_s
        self._deadline_s: float | None = None
        self._held = False
        self._line_requested = False
        """``LineWanted`` was issued, and the owner has not given the line."""
        self._received_count = 0
        """Characters since the transfer began."""
        self._maybe_acked = False
        """Noise since the block was sent contained an ACK."""
        self._listing = bytearray()
        self._last_content = b""
        """Of the block that was accepted last."""
        self._last_ack = False
        """The last answer of this side was ACK: no end can follow NAK."""

    @property
    def held(self) -> bool:
        """Whether the other side asked for a pause, by DC3: no line should be given now."""
        return self._held

    @property
    def _what(self) -> str:
        """What is transferred, for messages."""
        return "the directory" if self.header is None else "the file"

    @property
    def noise_bytes(self) -> int:
        """Received bytes that were discarded as noise."""
        return self._lexer.noise_bytes

    # ---------------------------------------------------------------------------------- for the driver

    def receive(self, data: bytes, now_s: float) -> None:
        """Process received bytes, of which the last arrived at NOW_S."""
        self.handle_timer(now_s - len(data) * self.options.character_time_s)
        self._now_s = max(self._now_s, now_s)
        self._received_count += len(data)
        if self.state is State.LISTING:
            self._take_listing(data)
        self._process_tokens(self._lexer.receive(data, now_s))

    def handle_timer(self, now_s: float) -> None:
        """Handle expired deadlines."""
        self._now_s = max(self._now_s, now_s)
        if self.state is State.LISTING:
            self._end_listing(now_s)
        self._process_tokens(self._lexer.handle_timer(now_s))
        if self._deadline_s is None or now_s < self._deadline_s:
            return
        if self._lexer.next_deadline() is None or now_s >= self._deadline_s + self.options.answer_s:
            self._time_out()

    def next_deadline(self) -> float | None:
        """Return when ``handle_timer`` has to be called; None: not at all."""
        scanning_s = self._lexer.next_deadline()
        if scanning_s is None or self._deadline_s is None:
            return self._deadline_s if scanning_s is None else scanning_s
        # Received data is processed before the answer times out, unless the data never ends.
        return min(scanning_s, self._deadline_s + self.options.answer_s)

    def take_output(self) -> bytes:
        """Return bytes for the line."""
        output = bytes(self._output)
        self._output.clear()
        return output

    def take_events(self) -> list[events.Event]:
        """Return the events since the last call."""
        happened, self._events = self._events, []
        return happened

    # ----------------------------------------------------------------------------------- for the owner

    def fetch(self, code: str, name: str) -> None:
        """Control: request a file; an empty name requests the next one. Raises BadText."""
        self._send_header(Header(code, name, INPUT))

    def send(self, code: str, name: str) -> None:
        """Control: announce a file; ``LineWanted`` follows when the peripheral accepts it. Raises BadText."""
        self._send_header(Header(code, name, OUTPUT))

    def ask_directory(self) -> None:
        """Control: request the directory."""
        self._begin(None)
        self._listing.clear()
        self._lexer.reset()
        self._say(DIRECTORY_REQUEST)
        self._wait(State.LISTING, self.options.decide_s)

    def give_directory(self, text: bytes) -> None:
        """Peripheral: answer ``DirectoryAsked``."""
        self._say(text + bytes((ETX,)))
        # The tolerance is as for a block: for two clocks that differ.
        self._left_s = self._busy_until_s - (0.5 + 0.08 * len(text)) * self.options.character_time_s
        self._wait(State.ETX_SENT, self.options.answer_s)
        self._tries = self.options.transmissions  # not a block, so not repeated

    def give_line(self, text: bytes) -> None:
        """Send a line, given without CR LF; raises BadText, with nothing sent, if no block can carry it."""
        assert self.state is State.LINE_WANTED
        if len(text) + 2 > self.options.block_max:
            raise BadText(
                f"line {self.lines + 1} has {len(text)} characters;"
                f" a block has at most {self.options.block_max - 2}"
            )
        if b"\r" in text or b"\n" in text or not is_text(text, self.options.frame.data_bits):
            raise BadText(
                f"line {self.lines + 1} has {_invalid_character(text, self.options.frame.data_bits)}"
            )
        self._tries = 0
        self._line_requested = False
        self._transmit(STX, text + CRLF)
        self._wait(State.BLOCK_SENT, self.options.answer_s)

    def give_end(self) -> None:
        """Announce that the previous line was the last."""
        assert self.state is State.LINE_WANTED
        self._tries = 1
        self._line_requested = False
        if self.is_peripheral:
            self._send_etx()
        else:
            self._say(bytes((ETX, EOT)))
            self._end(events.Sent(confirmed=False))

    def line_taken(self) -> None:
        """Acknowledge the line of the last ``Line``."""
        assert self.state is State.LINE_GIVEN
        self.lines += 1
        self._answer(ACK)

    def file_kept(self) -> None:
        """Answer ``Ended``: the file is stored."""
        assert self.state is State.END_GIVEN
        if not self.is_peripheral:
            self._say(bytes((EOT,)))
        self._idle()

    def accept(self) -> None:
        """Peripheral: accept the request of the header."""
        assert self.state is State.ASKED
        assert self.header is not None
        self._say(bytes((ACK,)))
        self._last_ack = True
        if self.header.mode == OUTPUT:
            self._wait(State.RECEIVING, self.options.answer_s)
        else:
            self._want_line()

    def refuse(self, text: str) -> None:
        """Peripheral: report an error to the control, also during a file. This ends the transfer."""
        line = "".join(c if c.isascii() and c.isprintable() else "?" for c in text)[:ERROR_TEXT_MAX]
        self._tries = 0
        self._transmit(SOH, line.encode("ascii"))
        self._wait(State.ERROR_SENT, self.options.answer_s)

    def fail(self, sentence: str) -> None:
        """Abort the transfer for the reason SENTENCE; the other side receives EOT."""
        self._say(bytes((EOT,)))
        self._end(events.Failed(sentence))

    # ------------------------------------------------------------------------------------------ directory

    def _take_listing(self, data: bytes) -> None:
        self._listing += data[: DIRECTORY_MAX + 1 - len(self._listing)]
        self._deadline_s = self._now_s + (
            self.options.character_s
            if self._listing.rstrip(b"\0").endswith(bytes((ETX,)))
            else self.options.answer_s
        )
        if len(self._listing) > DIRECTORY_MAX:
            self.fail(f"the directory is longer than {DIRECTORY_MAX} bytes")

    def _end_listing(self, now_s: float) -> None:
        if self._deadline_s is None or now_s < self._deadline_s:
            return
        text = bytes(self._listing).rstrip(b"\0")
        if text.endswith(bytes((ETX,))):
            self._say(bytes((EOT,)))
            self._end(events.Directory(text[:-1]))

    # ------------------------------------------------------------------------------------------- sending

    def _send_header(self, header: Header) -> None:
        self._begin(header)
        self._transmit(SOH, header.to_content())
        self._wait(State.HEADER_SENT, self.options.decide_s)

    def _begin(self, header: Header | None) -> None:
        assert self.state in (State.IDLE, State.ASKED)
        self.header = header
        self.lines = self._received_count = 0
        self._tries = 0
        self._held = self._line_requested = False
        self._last_ack = True

    def _transmit(self, start: int, content: bytes) -> None:
        options = self.options
        self._sent = write_block(start, content, avoid_control=options.avoid_control, dc1=options.dc1)
        self._repeat()

    def _repeat(self) -> None:
        self._tries += 1
        self._maybe_acked = False
        self._say(self._sent)
        # The tolerance is for two clocks that differ; an answer before DC1 is one.
        block_s = (len(self._sent) - self.options.dc1) * self.options.character_time_s
        self._left_s = self._busy_until_s - self.options.dc1 * self.options.character_time_s - 0.08 * block_s
        # If it is unknown when the block leaves, the real answer may follow a false one that much later.
        self._lexer.nak_extra_s = 0.0 if self.options.paced else 1.1 * block_s

    def _say(self, data: bytes) -> None:
        self._output += data
        time_s = len(data) * self.options.character_time_s
        self._busy_until_s = max(self._busy_until_s, self._now_s) + time_s

    def _answer(self, character: int) -> None:
        self._say(bytes((character,)))
        self._last_ack = character == ACK
        self._wait(State.RECEIVING, self.options.answer_s)

    def _want_line(self) -> None:
        if self._held:
            self._wait(State.LINE_WANTED, self.options.decide_s)
        else:
            self._wait(State.LINE_WANTED, None)
            if not self._line_requested:
                self._line_requested = True
                self._events.append(events.LineWanted())

    def _wait(self, state: State, patience_s: float | None) -> None:
        self.state = state
        receiving = state in (State.IDLE, State.RECEIVING, State.LINE_GIVEN, State.END_GIVEN, State.ASKED)
        self._lexer.expects_blocks = receiving
        self._lexer.answer_leads = state in (State.HEADER_SENT, State.ERROR_SENT)
        self._deadline_s = None if patience_s is None else max(self._busy_until_s, self._now_s) + patience_s

    def _idle(self) -> None:
        self._wait(State.IDLE, None)

    def _end(self, event: events.Event) -> None:
        """End the transfer; discard its events that the owner could no longer answer."""
        self._idle()
        self._line_requested = False
        self._events = [e for e in self._events if isinstance(e, events.Failed | events.Sent)]
        self._events.append(event)

    def _time_out(self) -> None:
        if self.state is State.LINE_WANTED:
            self.fail(
                f"the other side asked for a pause and did not continue within {self.options.decide_s:g} s"
            )
        elif self.state is State.ERROR_SENT:
            self._end(events.Failed("the other side did not answer the error report"))
        elif self._received_count and self.state in (State.HEADER_SENT, State.LISTING):
            self.fail("the answer of the other side cannot be read; check baud rate, parity and the cable")
        else:
            what = {
                State.HEADER_SENT: "the header",
                State.RECEIVING: f"line {self.lines}, the last one received"
                if self.lines
                else "the header's answer",
                State.ETX_SENT: f"the end of {self._what}",
                State.LISTING: "the request for the directory",
            }.get(self.state, f"line {self.lines + 1}")
            self.fail(
                f"nothing was received after {what} in time; check the cable, the other side and its settings"
            )

    def _send_etx(self) -> None:
        self._say(bytes((ETX,)))
        self._left_s = self._busy_until_s - 0.5 * self.options.character_time_s
        self._wait(State.ETX_SENT, self.options.answer_s)

    # ------------------------------------------------------------------------------ what the line says

    def _process_tokens(self, tokens: list[Token]) -> None:
        for token in tokens:
            if token.kind not in _QUIET and not self.options.paced:
                self._busy_until_s = min(self._busy_until_s, self._now_s)  # a fast line: it has left
            self._maybe_acked = self._maybe_acked or (token.kind is Kind.NOISE and bool(token.content))
            act = self._ACTS.get((self.state, token.kind))
            if act is not None:
                act(self, token)
            elif (token.kind, self.state) not in _IGNORED and self.state in _TRANSFER:
                self._out_of_step(token)

    def _out_of_step(self, token: Token) -> None:
        self.fail(
            f"the other side sent {_SHOWN[token.kind]} while this side waited for {self.state.value}:"
            " the two sides are out of step; the file was discarded"
        )

    def _ack_received(self, token: Token) -> None:
        if self._too_early(token):
            return
        if self.state is State.BLOCK_SENT:
            self.lines += 1
            self._want_line()
        elif self.header is not None and self.header.mode == INPUT:
            self._wait(State.RECEIVING, self.options.answer_s)
        else:
            self._want_line()

    def _nak_received(self, token: Token) -> None:
        if self._too_early(token):
            return
        what = {State.HEADER_SENT: "the header", State.ERROR_SENT: "the error"}.get(
            self.state, f"line {self.lines + 1}"
        )
        if self._maybe_acked and self.state is State.BLOCK_SENT:
            self.fail(f"{what} was refused, but noise before may have been its ACK; send the file again")
            return
        if self._tries >= self.options.transmissions:
            self.fail(f"{what} was refused {self._tries} times; check baud rate, parity and the cable")
            return
        self.repeats += 1
        self._repeat()
        self._wait(
            self.state,
            self.options.answer_s if self.state is not State.HEADER_SENT else self.options.decide_s,
        )

    def _too_early(self, token: Token) -> bool:
        """End a transfer if an answer arrived before its block was sent: it belongs to the block before."""
        early = self.options.paced and token.at_s < self._left_s
        if early and self.header is None:
            self.fail("the control ended the directory before all of it was sent")
        elif early:
            self.fail(
                "an answer was received before its block was sent, so an earlier one was noise;"
                " nothing is kept"
            )
        return early

    def _etx_nak_received(self, _: Token) -> None:
        if self._tries >= self.options.transmissions:
            self.fail(f"the end of {self._what} was refused; check baud rate, parity and the cable")
            return
        self._tries += 1
        self.repeats += 1
        self._send_etx()

    def _confirmed(self, token: Token) -> None:
        if self._too_early(token):
            return
        if token.at_s - self._left_s > self.options.answer_s / 2:
            # A control that aborts sends the same as one that received everything.
            self._end(
                events.Failed(
                    f"the control ended the transfer late; it is unknown whether it has {self._what}"
                )
            )
        else:
            self._end(events.Sent(confirmed=True))

    def _eot_received(self, _: Token) -> None:
        place = f"after line {self.lines}" if self.lines else "before the first line"
        self._end(events.Failed(f"the other side ended the transfer {place}"))

    def _block_received(self, token: Token) -> None:
        if self.state is State.HEADER_SENT and self.header is not None and self.header.mode == OUTPUT:
            self._out_of_step(token)
            return
        if not self._last_ack and self.lines and token.content == self._last_content:
            # The NAK may have answered noise, and the ACK before be lost: then this is the same line again.
            self.fail(
                f"line {self.lines} was received again after noise on the line; it is unknown whether the"
                " program has it twice; send the file again"
            )
            return
        self._last_content = token.content
        self._tries = 0
        self._wait(State.LINE_GIVEN, None)
        self._events.append(
            events.Line(strip_text(token.content, token.check, avoid_control=self.options.avoid_control))
        )

    def _damaged(self, token: Token) -> None:
        self._tries += 1
        self.repeats += 1
        if self._tries >= self.options.transmissions:
            what = f"line {self.lines + 1}" if self.state is State.RECEIVING else "the header"
            self.fail(
                f"{what} was received damaged {self._tries} times; the last {token.reason};"
                " check baud rate and parity"
            )
        else:
            self._say(bytes((NAK,)))
            self._last_ack = False
            if self.state is State.RECEIVING:
                self._wait(State.RECEIVING, self.options.answer_s)

    def _damaged_idle(self, _: Token) -> None:
        if self.is_peripheral:
            self._say(bytes((NAK,)))

    def _ended(self, token: Token) -> None:
        assert self.header is not None
        pair = self.header.mode == OUTPUT
        if not self._last_ack or pair != (token.kind is Kind.END):
            return  # noise: an end follows an ACK, and is ETX EOT only in output
        if self.state is State.HEADER_SENT and self.header.name:
            return  # likewise: an immediate end answers only a request for the next file
        self._wait(State.END_GIVEN, None)
        self._events.append(events.Ended())

    def _header_received(self, token: Token) -> None:
        if not self.is_peripheral:
            if self.state is not State.IDLE:
                self._error_received(token)
            return
        header = read_header(token.content)
        again = self.state is State.RECEIVING and self.lines == 0 and header == self.header
        if self.state is not State.IDLE and not again:
            self._end(events.Failed(f"the control began a new transfer after line {self.lines}"))
        self._idle()
        if header is None:
            self.refuse("NO SUCH FILE")
        elif again:
            self._wait(State.ASKED, None)
            self.accept()
        else:
            self._begin(header)
            self._wait(State.ASKED, None)
            self._events.append(events.Asked(header))

    def _error_received(self, token: Token) -> None:
        text = printable(token.content.decode("latin-1").rstrip())
        self._say(bytes((ACK, EOT)))
        self._end(events.Failed(f"the peripheral reports: {text or 'an error'}"))

    def _directory_asked(self, _: Token) -> None:
        if not self.is_peripheral:
            return
        self._begin(None)
        self._wait(State.ASKED, None)
        self._events.append(events.DirectoryAsked())

    def _error_acked(self, _: Token) -> None:
        self._end(events.Failed("an error was reported to the control"))

    def _hold(self, _: Token) -> None:
        self._held = True
        if self.state is State.BLOCK_SENT:
            self._wait(State.BLOCK_SENT, self.options.decide_s)

    def _go_on(self, _: Token) -> None:
        held, self._held = self._held, False
        if held and self.state is State.LINE_WANTED:
            self._want_line()

    _Act = Callable[["Engine", Token], None]
    _ACTS: ClassVar[dict[tuple[State, Kind], _Act]] = {
        (State.IDLE, Kind.HEADER): _header_received,
        (State.IDLE, Kind.DAMAGED): _damaged_idle,
        (State.IDLE, Kind.DIRECTORY): _directory_asked,
        (State.HEADER_SENT, Kind.ACK): _ack_received,
        (State.HEADER_SENT, Kind.NAK): _nak_received,
        (State.HEADER_SENT, Kind.EOT): _eot_received,
        (State.HEADER_SENT, Kind.HEADER): _header_received,
        (State.HEADER_SENT, Kind.BLOCK): _block_received,
        (State.HEADER_SENT, Kind.ETX): _ended,
        (State.LINE_WANTED, Kind.EOT): _eot_received,
        (State.LINE_WANTED, Kind.HEADER): _header_received,
        (State.LINE_WANTED, Kind.HOLD): _hold,
        (State.LINE_WANTED, Kind.GO_ON): _go_on,
        (State.BLOCK_SENT, Kind.ACK): _ack_received,
        (State.BLOCK_SENT, Kind.NAK): _nak_received,
        (State.BLOCK_SENT, Kind.EOT): _eot_received,
        (State.BLOCK_SENT, Kind.HEADER): _header_received,
        (State.BLOCK_SENT, Kind.HOLD): _hold,
        (State.BLOCK_SENT, Kind.GO_ON): _go_on,
        (State.ETX_SENT, Kind.EOT): _confirmed,
        (State.ETX_SENT, Kind.NAK): _etx_nak_received,
        (State.ETX_SENT, Kind.HEADER): _header_received,
        (State.RECEIVING, Kind.BLOCK): _block_received,
        (State.RECEIVING, Kind.HEADER): _header_received,
        (State.RECEIVING, Kind.DAMAGED): _damaged,
        (State.RECEIVING, Kind.ETX): _ended,
        (State.RECEIVING, Kind.END): _ended,
        (State.RECEIVING, Kind.EOT): _eot_received,
        (State.LINE_GIVEN, Kind.EOT): _eot_received,
        (State.LINE_GIVEN, Kind.HEADER): _header_received,
        (State.END_GIVEN, Kind.EOT): _eot_received,
        (State.ASKED, Kind.EOT): _eot_received,
        (State.LISTING, Kind.HEADER): _header_received,
        (State.ERROR_SENT, Kind.ACK): _error_acked,
        (State.ERROR_SENT, Kind.EOT): _error_acked,
        (State.ERROR_SENT, Kind.NAK): _nak_received,
        (State.ERROR_SENT, Kind.HEADER): _header_received,
    }


def _invalid_character(text: bytes, data_bits: int) -> str:
    """Name the first character of TEXT that no block can carry."""
    odd = next(c for c in text if c < 0x20 or c == 0x7F or (data_bits == 7 and c > 0x7F))
    if odd > 0x7F:
        return f"the character {odd:02X} hex, which does not fit into 7 bits; use the frame 8N1"
    return f"the control character {odd:02X} hex, which no block can carry; remove it"

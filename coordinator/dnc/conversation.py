"""What both roles share: the state of a conversation, what is said, how long is waited. See ``engine``."""

from enum import Enum
from typing import Final

from coordinator.dnc import events
from coordinator.dnc.blocks import ACK, EOT, ETX, OUTPUT, SOH, Header, write_block
from coordinator.dnc.lexer import Scanner
from coordinator.dnc.options import DncOptions

ERROR_TEXT_MAX: Final = 32
"""Characters of an error's text: more, old controls do not show."""


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


class Conversation:
    """One end of a line: base of ``Engine``, whose methods are for its owner."""

    def __init__(self, options: DncOptions, now_s: float, *, peripheral: bool) -> None:
        self.options = options
        self.state = State.IDLE
        self.header: Header | None = None
        """Of the transfer that is on, or was last."""
        self.lines = 0
        """Of that transfer, acknowledged."""
        self.repeats = 0
        """Blocks sent or asked for again since the engine was made."""
        self.is_peripheral = peripheral
        self._scanner = Scanner(options)
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
        self._wants_line = False
        """The owner was told that a line is wanted, and has not given it."""
        self._heard = 0
        """Characters since the transfer began."""
        self._maybe_acked = False
        """There was an ACK in the noise since the block was sent."""
        self._listing = bytearray()
        self._last_content = b""
        """Of the block that was taken last."""
        self._last_ack = False
        """The last answer given was ACK: after NAK no end can come."""

    @property
    def held(self) -> bool:
        """Whether the other side asked for a pause, by DC3: no line should be given now."""
        return self._held

    @property
    def _what(self) -> str:
        """What the transfer that is on is about, for sentences."""
        return "the directory" if self.header is None else "the file"

    @property
    def noise_bytes(self) -> int:
        """Bytes so far that meant nothing."""
        return self._scanner.noise_bytes

    def accept(self) -> None:
        """Peripheral: take the file or send it, as the header asked."""
        assert self.state is State.ASKED
        assert self.header is not None
        self._say(bytes((ACK,)))
        self._last_ack = True
        if self.header.mode == OUTPUT:
            self._wait(State.RECEIVING, self.options.answer_s)
        else:
            self._want_line()

    def refuse(self, text: str) -> None:
        """Peripheral: tell the control of an error instead; also amidst a file. The transfer is over."""
        line = "".join(c if c.isascii() and c.isprintable() else "?" for c in text)[:ERROR_TEXT_MAX]
        self._tries = 0
        self._transmit(SOH, line.encode("ascii"))
        self._wait(State.ERROR_SENT, self.options.answer_s)

    def fail(self, sentence: str) -> None:
        """Give the transfer up, for the reason SENTENCE; the other side gets EOT."""
        self._say(bytes((EOT,)))
        self._end(events.Failed(sentence))

    # ------------------------------------------------------------------------------------------- sending

    def _send_header(self, header: Header) -> None:
        self._begin(header)
        self._transmit(SOH, header.to_content())
        self._wait(State.HEADER_SENT, self.options.decide_s)

    def _begin(self, header: Header | None) -> None:
        assert self.state in (State.IDLE, State.ASKED)
        self.header = header
        self.lines = self._heard = 0
        self._tries = 0
        self._held = self._wants_line = False
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
        # Where it is not known when it leaves, an answer may come that late, after another that is none.
        self._scanner.nak_extra_s = 0.0 if self.options.paced else 1.1 * block_s

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
            if not self._wants_line:
                self._wants_line = True
                self._events.append(events.LineWanted())

    def _wait(self, state: State, patience_s: float | None) -> None:
        self.state = state
        receiving = state in (State.IDLE, State.RECEIVING, State.LINE_GIVEN, State.END_GIVEN, State.ASKED)
        self._scanner.expects_blocks = receiving
        self._scanner.answer_leads = state in (State.HEADER_SENT, State.ERROR_SENT)
        self._deadline_s = None if patience_s is None else max(self._busy_until_s, self._now_s) + patience_s

    def _idle(self) -> None:
        self._wait(State.IDLE, None)

    def _end(self, event: events.Event) -> None:
        """End the transfer; what the owner has not yet heard of it and could no longer answer, is void."""
        self._idle()
        self._wants_line = False
        self._events = [e for e in self._events if isinstance(e, events.Failed | events.Sent)]
        self._events.append(event)

    def _time_out(self) -> None:
        if self.state is State.LINE_WANTED:
            self.fail(
                f"the other side asked for a pause and did not go on within {self.options.decide_s:g} s"
            )
        elif self.state is State.ERROR_SENT:
            self._end(events.Failed("the other side did not answer the error it was told"))
        elif self._heard and self.state in (State.HEADER_SENT, State.LISTING):
            self.fail("what the other side answers cannot be read; check baud rate, parity and the cable")
        else:
            what = {
                State.HEADER_SENT: "the header",
                State.RECEIVING: f"line {self.lines}, the last one that came"
                if self.lines
                else "the header's answer",
                State.ETX_SENT: f"the end of {self._what}",
                State.LISTING: "the request for the directory",
            }.get(self.state, f"line {self.lines + 1}")
            self.fail(f"nothing came after {what} in time; check the cable, the other side and its settings")

    def _say_etx(self) -> None:
        self._say(bytes((ETX,)))
        self._left_s = self._busy_until_s - 0.5 * self.options.character_time_s
        self._wait(State.ETX_SENT, self.options.answer_s)

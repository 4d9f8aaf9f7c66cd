"""The conversation about files over one line, as the control or as the peripheral. Sans-IO.

A block is repeated on NAK and on nothing else: blocks have no number, so that a repeat for want of an answer
would double a line whenever the answer got lost. Whoever misses an answer sends EOT and has failed.

    control  fetch:      SOH K name E →   ← ACK, blocks, each ACK →   ← ETX   EOT →
    control  send:       SOH K name A →   ← ACK   blocks →, each ← ACK   ETX EOT →
    control  directory:  DC3 ESC DC1 0 SP D CR LF →   ← lines of text, ETX   EOT →
    error of a peripheral: ← SOH text ETB BCC   ACK EOT →

The owner passes on bytes and time, sends what ``take_output`` returns, and answers ``take_events``.
Times are seconds of any clock that does not jump.
"""

from typing import Final

from coordinator.dnc import events
from coordinator.dnc.blocks import (
    ACK,
    CRLF,
    DIRECTORY_REQUEST,
    EOT,
    ETX,
    INPUT,
    OUTPUT,
    STX,
    BadText,
    Header,
    is_text,
)
from coordinator.dnc.conversation import State
from coordinator.dnc.handlers import Reactions

__all__ = ["Engine", "State"]

DIRECTORY_MAX: Final = 262_144
"""Bytes of a directory."""


class Engine(Reactions):
    """One end of a line."""

    # ---------------------------------------------------------------------------------- for the driver

    def receive(self, data: bytes, now_s: float) -> None:
        """Take bytes of the line, of which the last came at NOW_S."""
        self.handle_timer(now_s - len(data) * self.options.character_time_s)
        self._now_s = max(self._now_s, now_s)
        self._heard += len(data)
        if self.state is State.LISTING:
            self._take_listing(data)
        self._judge(self._scanner.receive(data, now_s))

    def handle_timer(self, now_s: float) -> None:
        """Do what is due."""
        self._now_s = max(self._now_s, now_s)
        if self.state is State.LISTING:
            self._end_listing(now_s)
        self._judge(self._scanner.handle_timer(now_s))
        if self._deadline_s is None or now_s < self._deadline_s:
            return
        if self._scanner.next_deadline() is None or now_s >= self._deadline_s + self.options.answer_s:
            self._time_out()

    def next_deadline(self) -> float | None:
        """Return when ``handle_timer`` shall be called; None: no need."""
        scanning_s = self._scanner.next_deadline()
        if scanning_s is None or self._deadline_s is None:
            return self._deadline_s if scanning_s is None else scanning_s
        # What is on the line is judged before patience ends, unless it never ends.
        return min(scanning_s, self._deadline_s + self.options.answer_s)

    def take_output(self) -> bytes:
        """Return bytes for the line."""
        output = bytes(self._output)
        self._output.clear()
        return output

    def take_events(self) -> list[events.Event]:
        """Return what happened since."""
        happened, self._events = self._events, []
        return happened

    # ----------------------------------------------------------------------------------- for the owner

    def fetch(self, code: str, name: str) -> None:
        """Control: ask for a file; an empty name asks for the next one. Raises BadText."""
        self._send_header(Header(code, name, INPUT))

    def send(self, code: str, name: str) -> None:
        """Control: announce a file; ``LineWanted`` comes when the peripheral takes it. Raises BadText."""
        self._send_header(Header(code, name, OUTPUT))

    def ask_directory(self) -> None:
        """Control: ask for the directory."""
        self._begin(None)
        self._listing.clear()
        self._scanner.reset()
        self._say(DIRECTORY_REQUEST)
        self._wait(State.LISTING, self.options.decide_s)

    def give_directory(self, text: bytes) -> None:
        """Peripheral: answer ``DirectoryAsked``."""
        self._say(text + bytes((ETX,)))
        # The tolerance is as for a block: for two clocks that differ.
        self._left_s = self._busy_until_s - (0.5 + 0.08 * len(text)) * self.options.character_time_s
        self._wait(State.ETX_SENT, self.options.answer_s)
        self._tries = self.options.transmissions  # it is no block: not repeated

    def give_line(self, text: bytes) -> None:
        """Send a line, given without CR LF; raises BadText, with nothing sent, if no block can carry it."""
        assert self.state is State.LINE_WANTED
        if len(text) + 2 > self.options.block_max:
            raise BadText(
                f"line {self.lines + 1} has {len(text)} characters;"
                f" a block takes {self.options.block_max - 2}"
            )
        if b"\r" in text or b"\n" in text or not is_text(text, self.options.frame.data_bits):
            raise BadText(f"line {self.lines + 1} has {_odd(text, self.options.frame.data_bits)}")
        self._tries = 0
        self._wants_line = False
        self._transmit(STX, text + CRLF)
        self._wait(State.BLOCK_SENT, self.options.answer_s)

    def give_end(self) -> None:
        """Say that the line before was the last."""
        assert self.state is State.LINE_WANTED
        self._tries = 1
        self._wants_line = False
        if self.is_peripheral:
            self._say_etx()
        else:
            self._say(bytes((ETX, EOT)))
            self._end(events.Sent(confirmed=False))

    def line_taken(self) -> None:
        """Acknowledge the line of the last ``Line``."""
        assert self.state is State.LINE_GIVEN
        self.lines += 1
        self._answer(ACK)

    def file_kept(self) -> None:
        """Answer ``Ended``: the file is safe."""
        assert self.state is State.END_GIVEN
        if not self.is_peripheral:
            self._say(bytes((EOT,)))
        self._idle()

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


def _odd(text: bytes, data_bits: int) -> str:
    """Name the first character of TEXT that no block can carry."""
    odd = next(c for c in text if c < 0x20 or c == 0x7F or (data_bits == 7 and c > 0x7F))
    if odd > 0x7F:
        return f"the character {odd:02X} hex, which does not fit into 7 bits; use the frame 8N1"
    return f"the control character {odd:02X} hex, which no block can carry; take it out"

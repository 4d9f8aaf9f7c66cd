"""What an engine does about what comes over the line, by what it waits for. See ``engine``."""

from collections.abc import Callable
from typing import ClassVar, Final

from coordinator.dnc import events
from coordinator.dnc.blocks import ACK, EOT, INPUT, NAK, OUTPUT, read_header, strip_text
from coordinator.dnc.conversation import Conversation, State
from coordinator.dnc.tokens import Kind, Sign

_TRANSFER: Final = frozenset(State) - {State.IDLE, State.ASKED, State.ERROR_SENT, State.LISTING}
_QUIET: Final = (Kind.NOISE, Kind.HOLD, Kind.GO_ON)
_IGNORED: Final = frozenset((kind, state) for kind in _QUIET for state in State) | {
    # Answers that noise made do no harm where blocks are expected.
    *(
        (kind, state)
        for kind in (Kind.ACK, Kind.NAK, Kind.CONFLICT, Kind.DIRECTORY)
        for state in (State.RECEIVING, State.LINE_GIVEN, State.END_GIVEN)
    ),
    # What is like a block, where answers are expected, is noise.
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


class Reactions(Conversation):
    """Base of ``Engine``: one method for each thing to be done, and a table of when."""

    # -------------------------------------------------------------------------------------------- signs

    def _judge(self, signs: list[Sign]) -> None:
        for sign in signs:
            if sign.kind not in _QUIET and not self.options.paced:
                self._busy_until_s = min(self._busy_until_s, self._now_s)  # a fast line: it has left
            self._maybe_acked = self._maybe_acked or (sign.kind is Kind.NOISE and bool(sign.content))
            act = self._ACTS.get((self.state, sign.kind))
            if act is not None:
                act(self, sign)
            elif (sign.kind, self.state) not in _IGNORED and self.state in _TRANSFER:
                self._out_of_step(sign)

    def _out_of_step(self, sign: Sign) -> None:
        self.fail(
            f"the other side sent {_SHOWN[sign.kind]} while this side waited for {self.state.value}:"
            " the two are out of step; nothing is kept"
        )

    def _acked(self, sign: Sign) -> None:
        if self._too_early(sign):
            return
        if self.state is State.BLOCK_SENT:
            self.lines += 1
            self._want_line()
        elif self.header is not None and self.header.mode == INPUT:
            self._wait(State.RECEIVING, self.options.answer_s)
        else:
            self._want_line()

    def _naked(self, sign: Sign) -> None:
        if self._too_early(sign):
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

    def _too_early(self, sign: Sign) -> bool:
        """End a transfer in which an answer came before its block can have: it was the one before's."""
        early = self.options.paced and sign.at_s < self._left_s
        if early and self.header is None:
            self.fail("the control ended the directory before all of it was sent")
        elif early:
            self.fail("an answer came before its block was sent: one before was noise; nothing is kept")
        return early

    def _naked_end(self, _: Sign) -> None:
        if self._tries >= self.options.transmissions:
            self.fail(f"the end of {self._what} was refused; check baud rate, parity and the cable")
            return
        self._tries += 1
        self.repeats += 1
        self._say_etx()

    def _confirmed(self, sign: Sign) -> None:
        if self._too_early(sign):
            return
        if sign.at_s - self._left_s > self.options.answer_s / 2:
            # The control that gives up says the same as the one that has all.
            self._end(
                events.Failed(
                    f"the control ended the transfer late: whether it has {self._what} is not known"
                )
            )
        else:
            self._end(events.Sent(confirmed=True))

    def _given_up(self, _: Sign) -> None:
        place = f"after line {self.lines}" if self.lines else "before the first line"
        self._end(events.Failed(f"the other side ended the transfer {place}"))

    def _block_came(self, sign: Sign) -> None:
        if self.state is State.HEADER_SENT and self.header is not None and self.header.mode == OUTPUT:
            self._out_of_step(sign)
            return
        if not self._last_ack and self.lines and sign.content == self._last_content:
            # NAK may have gone to noise, and the ACK before it got lost: then this is the line before again.
            self.fail(
                f"line {self.lines} came once more after noise on the line: whether the program has it twice"
                " cannot be told; send the file again"
            )
            return
        self._last_content = sign.content
        self._tries = 0
        self._wait(State.LINE_GIVEN, None)
        self._events.append(
            events.Line(strip_text(sign.content, sign.check, avoid_control=self.options.avoid_control))
        )

    def _damaged(self, sign: Sign) -> None:
        self._tries += 1
        self.repeats += 1
        if self._tries >= self.options.transmissions:
            what = f"line {self.lines + 1}" if self.state is State.RECEIVING else "the header"
            self.fail(
                f"{what} came damaged {self._tries} times; the last {sign.reason}; check baud rate and parity"
            )
        else:
            self._say(bytes((NAK,)))
            self._last_ack = False
            if self.state is State.RECEIVING:
                self._wait(State.RECEIVING, self.options.answer_s)

    def _damaged_idle(self, _: Sign) -> None:
        if self.is_peripheral:
            self._say(bytes((NAK,)))

    def _ended(self, sign: Sign) -> None:
        assert self.header is not None
        pair = self.header.mode == OUTPUT
        if not self._last_ack or pair != (sign.kind is Kind.END):
            return  # noise: an end follows an ACK, and is ETX EOT in output alone
        if self.state is State.HEADER_SENT and self.header.name:
            return  # likewise: only who asks for the next file may be told at once that there is none
        self._wait(State.END_GIVEN, None)
        self._events.append(events.Ended())

    def _header_came(self, sign: Sign) -> None:
        if not self.is_peripheral:
            if self.state is not State.IDLE:
                self._error_came(sign)
            return
        header = read_header(sign.content)
        again = self.state is State.RECEIVING and self.lines == 0 and header == self.header
        if self.state is not State.IDLE and not again:
            self._end(events.Failed(f"the control began anew after line {self.lines}"))
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

    def _error_came(self, sign: Sign) -> None:
        text = "".join(c if c.isprintable() else "?" for c in sign.content.decode("latin-1").rstrip())
        self._say(bytes((ACK, EOT)))
        self._end(events.Failed(f"the peripheral says: {text or 'an error'}"))

    def _directory_asked(self, _: Sign) -> None:
        if not self.is_peripheral:
            return
        self._begin(None)
        self._wait(State.ASKED, None)
        self._events.append(events.DirectoryAsked())

    def _error_acked(self, _: Sign) -> None:
        self._end(events.Failed("the control was told of an error"))

    def _hold(self, _: Sign) -> None:
        self._held = True
        if self.state is State.BLOCK_SENT:
            self._wait(State.BLOCK_SENT, self.options.decide_s)

    def _go_on(self, _: Sign) -> None:
        held, self._held = self._held, False
        if held and self.state is State.LINE_WANTED:
            self._want_line()

    _Act = Callable[["Reactions", Sign], None]
    _ACTS: ClassVar[dict[tuple[State, Kind], _Act]] = {
        (State.IDLE, Kind.HEADER): _header_came,
        (State.IDLE, Kind.DAMAGED): _damaged_idle,
        (State.IDLE, Kind.DIRECTORY): _directory_asked,
        (State.HEADER_SENT, Kind.ACK): _acked,
        (State.HEADER_SENT, Kind.NAK): _naked,
        (State.HEADER_SENT, Kind.EOT): _given_up,
        (State.HEADER_SENT, Kind.HEADER): _header_came,
        (State.HEADER_SENT, Kind.BLOCK): _block_came,
        (State.HEADER_SENT, Kind.ETX): _ended,
        (State.LINE_WANTED, Kind.EOT): _given_up,
        (State.LINE_WANTED, Kind.HEADER): _header_came,
        (State.LINE_WANTED, Kind.HOLD): _hold,
        (State.LINE_WANTED, Kind.GO_ON): _go_on,
        (State.BLOCK_SENT, Kind.ACK): _acked,
        (State.BLOCK_SENT, Kind.NAK): _naked,
        (State.BLOCK_SENT, Kind.EOT): _given_up,
        (State.BLOCK_SENT, Kind.HEADER): _header_came,
        (State.BLOCK_SENT, Kind.HOLD): _hold,
        (State.BLOCK_SENT, Kind.GO_ON): _go_on,
        (State.ETX_SENT, Kind.EOT): _confirmed,
        (State.ETX_SENT, Kind.NAK): _naked_end,
        (State.ETX_SENT, Kind.HEADER): _header_came,
        (State.RECEIVING, Kind.BLOCK): _block_came,
        (State.RECEIVING, Kind.HEADER): _header_came,
        (State.RECEIVING, Kind.DAMAGED): _damaged,
        (State.RECEIVING, Kind.ETX): _ended,
        (State.RECEIVING, Kind.END): _ended,
        (State.RECEIVING, Kind.EOT): _given_up,
        (State.LINE_GIVEN, Kind.EOT): _given_up,
        (State.LINE_GIVEN, Kind.HEADER): _header_came,
        (State.END_GIVEN, Kind.EOT): _given_up,
        (State.ASKED, Kind.EOT): _given_up,
        (State.LISTING, Kind.HEADER): _header_came,
        (State.ERROR_SENT, Kind.ACK): _error_acked,
        (State.ERROR_SENT, Kind.EOT): _error_acked,
        (State.ERROR_SENT, Kind.NAK): _naked,
        (State.ERROR_SENT, Kind.HEADER): _header_came,
    }

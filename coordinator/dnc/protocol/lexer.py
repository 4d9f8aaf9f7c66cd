"""Converts received bytes to tokens: blocks, answers, ends, and damaged data.

On this half-duplex line silence follows each message, because the sender waits. This is a second check after
the block check, and the stronger one: if a flipped bit turns a 7 into ETB, the block ends early, but its rest
follows without a pause. So a token is accepted only if silence follows it:

    token                   silence
    block, header, ACK     1.5 characters: the next one would be there; behind a block's DC1 none at all
    NAK, EOT               NAK: ``nak_quiet_s``, since to repeat what was taken doubles a line; EOT as a block
    ETX                    ``character_s``: a damaged STX is an ETX, too, and the block's rest follows
    anything damaged       ``character_s``

Sans-IO. Times are seconds of a monotonic clock. A lexer never raises, and stores at most one block.
"""

import re
from enum import Enum, auto
from typing import Final

from coordinator.dnc.options import DncOptions
from coordinator.dnc.protocol.blocks import (
    ACK,
    CR,
    DC1,
    DC3,
    DIRECTORY_REQUEST,
    EOT,
    ETB,
    ETX,
    LF,
    NAK,
    SOH,
    SPACE,
    STX,
    block_check,
    is_text,
)
from coordinator.dnc.protocol.tokens import Kind, Token

STARTS: Final = (SOH, STX)
BLOCK_LIKE: Final = 16
"""Characters without a pause that cannot be only noise."""


_TEXT: Final = re.compile(rb"[\r\n -\xff]+")
_SIMPLE: Final = {ACK: Kind.ACK, NAK: Kind.NAK, ETX: Kind.ETX, EOT: Kind.EOT}


class _State(Enum):
    IDLE = auto()
    BLOCK = auto()
    CHECK = auto()
    DONE = auto()
    SIMPLE = auto()
    COMMAND = auto()
    JUNK = auto()


class Lexer:
    """Reads one direction of one line."""

    def __init__(self, options: DncOptions) -> None:
        self._options = options
        self._state = _State.IDLE
        self._last_s = 0.0
        self._data = bytearray()
        """BLOCK: with its first character. SIMPLE: the characters. COMMAND: likewise."""
        self._start = 0
        self._check = 0
        self._good = False
        self._dc1_seen = False
        self._reason = ""
        self._junk_bytes = 0
        self._holds_ack = False
        self._is_reported = False
        """The current junk is the rest of an OVERRUN that was reported."""
        self._awaits_check = False
        """The next character of the damaged data follows an ETB."""
        self._pause_s = 0.0
        """Silence before the character that is fed."""
        self._block_like = False
        self._unit_ended = False
        """An ETB and a check character were received."""
        self._first_part = b""
        """Of a block within which the line fell silent; its rest may still come."""
        self._rest = bytearray()
        self._etx_stands = False
        """The current junk followed an ETX."""
        self._ends_with_eot = False
        self._tokens: list[Token] = []
        self.expects_blocks = True
        """Otherwise answers are expected, and block-like data is noise."""
        self.answer_leads = False
        """An ACK may be followed by a block without a pause, as after a header."""
        self.nak_extra_s = 0.0
        """Additional wait after a NAK, during which the real answer to the block may follow."""
        self.noise_bytes = 0

    def reset(self) -> None:
        """Discard what was begun."""
        self._state = _State.IDLE
        self._tokens.clear()

    def receive(self, data: bytes, now_s: float) -> list[Token]:
        """Process DATA, whose last character arrived at NOW_S; return the complete tokens."""
        first_s = now_s - len(data) * self._options.character_time_s
        self._expire(first_s)
        self._pause_s = first_s - self._last_s
        gap = self._pause_s >= self._options.settle_s * 0.99
        self._last_s = max(self._last_s, now_s)
        at = 0
        while at < len(data):
            text = self._text_from(data, at)
            if text == at:
                self._feed(data[at], gap)
                at += 1
            else:
                self._data += data[at:text]
                at = text
            gap, self._pause_s = False, 0.0
        return self._take()

    def handle_timer(self, now_s: float) -> list[Token]:
        """Return the tokens that the silence until NOW_S completed."""
        self._expire(now_s)
        return self._take()

    def next_deadline(self) -> float | None:
        """Return when silence completes a token; None: nothing is begun."""
        wait_s = self._silence_s()
        return None if wait_s is None else self._last_s + wait_s

    def _take(self) -> list[Token]:
        tokens, self._tokens = self._tokens, []
        return tokens

    def _text_from(self, data: bytes, at: int) -> int:
        """Return where the text ends that is added to the block unchanged."""
        if self._state is not _State.BLOCK:
            return at
        room = self._options.block_max + 2 - len(self._data)  # its first character, and a stuffed space
        text = _TEXT.match(data, at, at + max(room, 0))
        return text.end() if text is not None else at

    # ------------------------------------------------------------------------------------------ silence

    def _silence_s(self) -> float | None:
        options = self._options
        match self._state:
            case _State.IDLE:
                return None
            case _State.DONE:
                return options.settle_s if self._good else options.character_s
            case _State.SIMPLE:
                if len(self._data) > 1:
                    return options.settle_s
                nak_s = options.nak_quiet_s + self.nak_extra_s
                return {NAK: nak_s, ETX: options.character_s}.get(self._data[0], options.settle_s)
            case _:
                return options.character_s

    def _expire(self, now_s: float) -> None:
        deadline = self.next_deadline()
        if deadline is None or now_s < deadline:
            return
        state, self._state = self._state, _State.IDLE
        match state:
            case _State.DONE if self._good:
                self._end_block()
            case _State.DONE:
                self._emit(Kind.DAMAGED, reason="did not match its check character")
            case _State.SIMPLE:
                self._emit(Kind.END if len(self._data) > 1 else _SIMPLE[self._data[0]])
            case _State.BLOCK | _State.CHECK:
                self._end_unfinished("has no end")
                self._first_part = bytes(self._data)
            case _State.COMMAND:
                self._noise(len(self._data))
            case _:
                self._end_unfinished(self._reason)

    def _end_block(self) -> None:
        self._state = _State.IDLE
        kind = Kind.HEADER if self._start == SOH else Kind.BLOCK
        self._emit(kind, content=bytes(self._data[1:-1]), check=self._check)

    def _end_unfinished(self, reason: str) -> None:
        first_part, self._first_part = self._first_part, b""
        if self._ends_with_eot:
            self._emit(Kind.EOT)
        elif first_part and _is_whole(first_part + self._rest):
            self._emit(Kind.NOISE)  # the line was slow; a second NAK would ask for two repeats
        elif self._block_like and not self._is_reported:
            self._emit(Kind.DAMAGED, reason=reason)
        elif self._etx_stands:
            self.noise_bytes += self._junk_bytes
            self._emit(Kind.ETX)
        else:
            self._emit(Kind.NOISE)

    # ---------------------------------------------------------------------------------------- characters

    def _feed(self, character: int, gap: bool) -> None:
        match self._state:
            case _State.IDLE:
                self._begin(character)
            case _State.BLOCK:
                self._in_block(character, gap)
            case _State.CHECK:
                self._check = character
                self._good = character == block_check(self._data)
                self._dc1_seen = False
                self._unit_ended = True
                self._state = _State.DONE
            case _State.DONE:
                self._after_block(character, gap)
            case _State.SIMPLE:
                self._after_simple(character, gap)
            case _State.COMMAND:
                self._in_command(character, gap)
            case _State.JUNK:
                self._in_junk(character, gap)

    def _begin(self, character: int) -> None:
        self._reason = ""
        self._unit_ended = self._ends_with_eot = self._etx_stands = self._is_reported = False
        self._block_like = False
        if character in STARTS:
            self._start = character
            self._data = bytearray((character,))
            self._first_part = b""
            self._block_like = True
            self._state = _State.BLOCK
        elif character in _SIMPLE:
            self._data = bytearray((character,))
            self._state = _State.SIMPLE
        elif character == DC3:
            self._emit(Kind.HOLD)
            self._data = bytearray((character,))
            self._state = _State.COMMAND
        elif character == DC1:
            self._emit(Kind.GO_ON)
        elif character == 0:
            self._noise(1)  # a leader of old tapes, or what a parity error left of a character
        else:
            self._to_junk("does not begin with STX", character)

    def _in_block(self, character: int, gap: bool) -> None:
        self._ends_with_eot = character == EOT
        if character in STARTS:
            self._restart(character, gap)
        elif character == ETB:
            self._data.append(character)
            if is_text(bytes(self._data[1:-1]), self._options.frame.data_bits):
                self._state = _State.CHECK
            else:
                self._to_junk("holds a character that no text has", character)
        elif character < SPACE and character not in (CR, LF):
            self._to_junk(f"holds the control character {character:02X}", character)
        elif len(self._data) > self._options.block_max + 1:  # its first character, and a stuffed space
            self._to_junk(f"is longer than {self._options.block_max} characters", character)
        else:
            self._data.append(character)

    def _after_block(self, character: int, gap: bool) -> None:
        if character == DC1 and self._good:
            self._end_block()  # no text holds DC1: this is the end, there is nothing to wait for
        elif character == DC1 and not self._dc1_seen:
            self._dc1_seen = True
        elif character in STARTS:
            self._restart(character, gap)
        else:
            self._to_junk("continues after its end", character)

    def _after_simple(self, character: int, gap: bool) -> None:
        first = self._data[0]
        if len(self._data) == 1 and first == ETX and character == EOT:
            # A lone ETX may be noise, and an EOT much later gives up: only together they are the end.
            if self._pause_s <= self._options.pair_s:
                self._data.append(character)
            else:
                self._noise(1)
                self._begin(character)
        elif first == ACK and self.answer_leads and not gap and character in (*STARTS, ETX, EOT):
            self._emit(Kind.ACK)
            self._begin(character)
        elif first == NAK and gap:
            self._after_nak(character)
        elif gap and character in STARTS:  # a lone ETX that was none
            self._noise(len(self._data))
            self._begin(character)
        elif not gap or first == ETX:
            self._etx_stands = gap  # after a pause, what begins no block is noise behind the end
            self.noise_bytes += not gap
            self._to_junk("does not begin with STX", character)
        else:
            self._noise(len(self._data))
            self._begin(character)

    def _after_nak(self, character: int) -> None:
        if character in STARTS:
            self._noise(1)
            self._begin(character)
        elif character in _SIMPLE:
            self._state = _State.IDLE
            self._emit(Kind.CONFLICT)
        else:
            self.noise_bytes += 1

    def _in_command(self, character: int, gap: bool) -> None:
        self._data.append(character)
        if bytes(self._data) == DIRECTORY_REQUEST:
            self._state = _State.IDLE
            self._emit(Kind.DIRECTORY)
        elif not DIRECTORY_REQUEST.startswith(self._data):
            known = len(self._data) - 1
            self._state = _State.IDLE
            if gap or known == 1:  # a DC3 by itself
                self._begin(character)
            else:
                self._to_junk("does not begin with STX", character)

    def _in_junk(self, character: int, gap: bool) -> None:
        self._ends_with_eot = character == EOT and not self._awaits_check
        if character in STARTS:
            self._restart(character, gap)
            return
        if (
            gap
            and character in _SIMPLE
            and (not self.expects_blocks or character == EOT or not self._block_like)
        ):
            self._emit(Kind.NOISE)
            self._begin(character)
            return
        self._junk_bytes += 1
        if len(self._rest) <= self._options.block_max + 2:
            self._rest.append(character)
        self._holds_ack = self._holds_ack or character == ACK
        if self._awaits_check:
            self._unit_ended = True
            self._awaits_check = False
        elif character == ETB:
            self._awaits_check = True
        self._block_like = self._block_like or self._unit_ended or self._junk_bytes > BLOCK_LIKE

    def _restart(self, character: int, gap: bool) -> None:
        """Handle the start of a block while another is not complete."""
        if not self.expects_blocks and (gap or self._state is _State.DONE):
            self._emit(Kind.NOISE)
            self._begin(character)
        elif self.expects_blocks and (self._unit_ended or (gap and self._block_like)):
            self._emit(Kind.OVERRUN)
            self._to_junk("came before the last was answered", character)
            self._is_reported = True
        elif gap:
            self._emit(Kind.NOISE)
            self._begin(character)
        else:
            self._block_like = True
            self._to_junk("holds the beginning of another", character)

    # ------------------------------------------------------------------------------------------- helpers

    def _to_junk(self, reason: str, character: int) -> None:
        if self._state is not _State.JUNK:
            self._junk_bytes = 0
            self._rest.clear()
            self._first_part = self._first_part if self._state is _State.IDLE else b""
            self._holds_ack = self._state is _State.SIMPLE and self._data[0] == ACK
            self._reason = reason
        self._junk_bytes += 1
        self._rest.append(character)
        self._awaits_check = character == ETB
        self._ends_with_eot = character == EOT
        self._state = _State.JUNK

    def _noise(self, count: int) -> None:
        self.noise_bytes += count
        self._state = _State.IDLE

    def _emit(self, kind: Kind, content: bytes = b"", check: int = 0, reason: str = "") -> None:
        if kind is Kind.NOISE:
            content = bytes((ACK,)) if self._holds_ack else b""
            self._noise(self._junk_bytes)
        self._tokens.append(Token(kind, self._last_s, content, check, reason))


def _is_whole(data: bytes) -> bool:
    """Return whether DATA is a complete block, with DC1 or without."""
    return any(
        len(block) > 2 and block[-2] == ETB and block_check(block[:-1]) == block[-1]
        for block in (data, data.removesuffix(bytes((DC1,))))
    )

"""The protocol as the manual's page tells it, both sides, word by word and nothing more.

No time-outs, no noise, no bounds: a witness for what goes over the line, not for use. The page shows the
control sending to the peripheral. A file's way back is the same with the blocks' roles exchanged: the control
sends the header with mode E, the peripheral acknowledges it, sends the blocks and ETX, the control says EOT.
"""

from collections.abc import Generator, Sequence

Talk = Generator[bytes, int, None]
"""Yields what is sent, and gets the next character that came."""

SOH, STX, ETX, EOT, ACK, DC1, NAK, ETB = 0x01, 0x02, 0x03, 0x04, 0x06, 0x11, 0x15, 0x17


def bcc(characters: bytes) -> int:
    """The BCC rounds the individual bits of the transferred characters in a block to even parity."""
    value = 0
    for bit in range(8):
        ones = sum(character >> bit & 1 for character in characters)
        value |= (ones % 2) << bit
    return value


def block(first: int, text: bytes, *, dc1: bool) -> bytes:
    """<SOH or STX> text <ETB> BCC <DC1>."""
    characters = bytes([first]) + text + bytes([ETB])
    return characters + bytes([bcc(characters)]) + (bytes([DC1]) if dc1 else b"")


def transmit(characters: bytes) -> Generator[bytes, int, bool]:
    """If <NAK> is transmitted, the same block has to be re-transmitted. This is repeated up to 15 times."""
    for _ in range(15):
        answer = yield characters
        while answer not in (ACK, NAK):
            if answer == EOT:
                return False
            answer = yield b""
        if answer == ACK:
            return True
    return False


def receive_block(first: int) -> Generator[bytes, int, tuple[bytes, bool]]:
    """The receiver computes a BCC from the received block and compares it with the received BCC."""
    characters = bytes([first])
    while characters[-1] != ETB:
        characters += bytes([(yield b"")])
    received = yield b""
    return characters[1:-1], received == bcc(characters)


def control_output(header: bytes, lines: Sequence[bytes], *, dc1: bool) -> Talk:
    """A file with the name PPP is to be transferred to a peripheral device."""
    if not (yield from transmit(block(SOH, header, dc1=dc1))):
        return
    for line in lines:
        if not (yield from transmit(block(STX, line, dc1=dc1))):
            return
    yield bytes([ETX, EOT])


def peripheral_output(headers: list[bytes], lines: list[bytes]) -> Talk:
    """The peripheral device's side of the same."""
    first = yield b""
    while first != EOT:
        if first in (SOH, STX):
            text, good = yield from receive_block(first)
            if good:
                (headers if first == SOH else lines).append(text)
            first = yield bytes([ACK if good else NAK])
        else:  # <DC1>, or <ETX> of <ETX><EOT>
            first = yield b""


def peripheral_input(headers: list[bytes], lines: Sequence[bytes], *, dc1: bool) -> Talk:
    """The control asks with a header of mode E, the peripheral sends."""
    good = False
    while not good:
        first = yield b""
        if first == SOH:
            text, good = yield from receive_block(first)
            if not good:
                yield bytes([NAK])
    headers.append(text)
    started = bytes([ACK])
    for line in lines:
        repeat = block(STX, line, dc1=dc1)
        for _ in range(15):
            answer = yield started + repeat
            started = b""
            while answer not in (ACK, NAK):
                if answer == EOT:
                    return
                answer = yield b""
            if answer == ACK:
                break
        else:
            return
    answer = yield started + bytes([ETX])
    while answer != EOT:
        answer = yield b""


def control_input(header: bytes, lines: list[bytes], *, dc1: bool) -> Talk:
    """The control's side of the same."""
    if not (yield from transmit(block(SOH, header, dc1=dc1))):
        return
    first = yield b""
    while first != ETX:
        if first == STX:
            text, good = yield from receive_block(first)
            if good:
                lines.append(text)
            first = yield bytes([ACK if good else NAK])
        else:
            first = yield b""
    yield bytes([EOT])


class LiteralEnd:
    """One of these at an end of a line."""

    def __init__(self, talk: Talk) -> None:
        self._talk = talk
        self._output = next(talk)
        self.is_over = False

    def receive(self, data: bytes, now_s: float) -> None:
        for character in data:
            if self.is_over:
                return
            try:
                self._output += self._talk.send(character)
            except StopIteration:
                self.is_over = True

    def handle_timer(self, now_s: float) -> None:
        raise AssertionError("it has no time-outs")

    def next_deadline(self) -> None:
        return None

    def take_output(self) -> bytes:
        output, self._output = self._output, b""
        return output

    def look(self, now_s: float) -> None:
        pass

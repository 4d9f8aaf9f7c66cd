"""A slow, obvious node: the node's side of spec 01, written from the text, sharing no code with the project.

Its commands: ``1 <n> <data>`` store, ``2 <n>`` ask (answered by ``3 <n>``), ``4`` stop. All numbers are VLQ.
"""

from dataclasses import dataclass, field

from tests.wire_twin import SYNC, block, crc16, read_vlq
from tests.wire_twin import vlq_encode as vlq


def store(number: int, size: int = 0) -> bytes:
    data = bytes((number + i) & 255 for i in range(size))
    return vlq(1) + vlq(number) + vlq(size) + data


def ask(number: int) -> bytes:
    return vlq(2) + vlq(number)


def answer(number: int) -> bytes:
    return vlq(3) + vlq(number)


STOP = vlq(4)


def split_commands(content: bytes) -> list[bytes]:
    """Cut a block's content into its commands."""
    commands = []
    at = 0
    while at < len(content):
        start = at
        kind, at = read_vlq(content, at)
        if kind in {1, 2}:
            _, at = read_vlq(content, at)
        if kind == 1:
            size, at = read_vlq(content, at)
            at += size
        assert kind in {1, 2, 4}, f"unknown command {kind}"
        assert at <= len(content), "a command is cut short"
        commands.append(content[start:at])
    return commands


@dataclass
class NodeTwin:
    """Feed it bytes; it returns the blocks it answers with."""

    expected: int = 0
    window: int = 192
    buffer: bytes = b""
    executed: list[bytes] = field(default_factory=list)
    hunting: bool = False
    errors: int = 0
    overflows: int = 0

    def receive(self, data: bytes) -> list[bytes]:
        room = self.window - len(self.buffer)
        self.overflows += len(data) > room
        self.buffer += data[:room]
        answers: list[bytes] = []
        while self._step(answers):
            pass
        return answers

    def _step(self, answers: list[bytes]) -> bool:
        """Take one thing from the front of the buffer; False: it needs more bytes."""
        if self.hunting:
            end = self.buffer.find(SYNC)
            self.hunting = end < 0
            self.buffer = b"" if end < 0 else self.buffer[end + 1 :]
        self.buffer = self.buffer.lstrip(bytes([SYNC]))
        if not self.buffer:
            return False
        length = self.buffer[0]
        bad = not 5 <= length <= 64 or (len(self.buffer) > 1 and self.buffer[1] >> 4 != 1)
        if not bad and len(self.buffer) < length:
            return False
        if (
            bad
            or self.buffer[length - 3 : length] != crc16(self.buffer[: length - 3]).to_bytes(2, "big") + b"~"
        ):
            self.errors += 1
            self.hunting = True
            answers.append(block(self.expected))
            return True
        whole, self.buffer = self.buffer[:length], self.buffer[length:]
        self._take(whole, answers)
        return True

    def _take(self, whole: bytes, answers: list[bytes]) -> None:
        if whole[1] & 15 == self.expected:
            self.expected = (self.expected + 1) & 15
            for command in split_commands(whole[2:-3]):
                self.executed.append(command)
                if command[0] == 2:
                    answers.append(block(self.expected, answer(read_vlq(command, 1)[0])))
        answers.append(block(self.expected))


@dataclass
class WindowObserver:
    """Sees both directions at the host's end and asserts that the host keeps to the window."""

    window: int = 192
    blocks_max: int = 15
    flying: dict[int, int] = field(default_factory=dict)
    newest: int = 0
    tail: bytes = b""
    most_bytes: int = 0
    most_blocks: int = 0

    def sent(self, data: bytes) -> None:
        body = data.lstrip(bytes([SYNC, 0]))
        whole = body[: body[0]]
        copy = body[len(whole) :].lstrip(bytes([SYNC]))
        assert copy in {b"", whole}, "one transmission is one block, or that block twice"
        seq = whole[1] & 15
        if len(whole) == 5:  # first contact: no commands, and any sequence
            self.flying.clear()
        elif seq != (self.newest + 1) & 15:  # a repeat: what is in flight counts from here
            known = dict.fromkeys(self.flying, 0)
            self.flying = known if seq in known else {seq: 0, **known}
        self.flying[seq] = len(body)
        self.newest = seq
        self.most_bytes = max(self.most_bytes, sum(self.flying.values()))
        self.most_blocks = max(self.most_blocks, len(self.flying))
        assert sum(self.flying.values()) <= self.window
        assert len(self.flying) <= self.blocks_max

    def received(self, data: bytes) -> None:
        """Note what reached the host: it may know of every sound block in there, but of no other."""
        seen = len(self.tail)
        tail = self.tail + data
        for end in (at for at in range(seen, len(tail)) if tail[at] == SYNC):
            for length in range(5, min(64, end + 1) + 1):
                if tail[end + 1 - length] != length:
                    continue
                whole = tail[end + 1 - length : end + 1]
                if whole == block(whole[1], whole[2:-3]):
                    self._answered(whole[1] & 15)
        self.tail = tail[-63:]

    def _answered(self, seq: int) -> None:
        if (seq - 1) & 15 in self.flying:
            for known in list(self.flying):
                del self.flying[known]
                if known == (seq - 1) & 15:
                    break

"""A serial line in virtual time with seeded faults, and what owns the engines at its ends."""

import heapq
import itertools
import random
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from coordinator.dnc.options import DncOptions
from coordinator.dnc.protocol import events
from coordinator.dnc.protocol.blocks import ACK, EOT, ETX, NAK, SOH, STX, Header
from coordinator.dnc.protocol.engine import Engine, State

LIMIT_S = 100_000.0


@dataclass(frozen=True)
class Faults:
    """Shares: of bits, of characters, of single ACKs and NAKs, of pauses."""

    bit_errors: float = 0.0
    lost: float = 0.0
    lost_answers: float = 0.0
    noise: float = 0.0
    chunk: int = 1
    """Characters an adapter hands on at once, at most."""
    delay_s: float = 0.0
    """An adapter's delay, at most."""
    visible: bool = True
    """No damage that nobody can see: such that cancels out in the block check; a lone character of noise that
    is by chance an ETX or EOT, or an ACK or NAK in place of an answer that got lost."""


class End(Protocol):
    """What is at an end of the line."""

    def receive(self, data: bytes, now_s: float) -> None: ...
    def handle_timer(self, now_s: float) -> None: ...
    def next_deadline(self) -> float | None: ...
    def take_output(self) -> bytes: ...
    def look(self, now_s: float) -> None:
        """Act on what happened."""

    @property
    def is_over(self) -> bool: ...


class Wire:
    """One direction."""

    def __init__(self, faults: Faults, options: DncOptions, chance: random.Random) -> None:
        self.faults, self.options, self.chance = faults, options, chance
        self.busy_until_s = 0.0
        self.lost_answer = False
        """The last answer did not arrive as it was sent."""
        self.damage = 0
        """XOR of what was changed since the block began."""
        self.log: list[tuple[float, str]] = []

    def send(self, data: bytes, now_s: float) -> list[tuple[float, bytes]]:
        """Return when what arrives."""
        time_s = self.options.character_time_s
        at_s = max(now_s, self.busy_until_s)
        arrived: list[tuple[float, int]] = []
        lost_answer = len(data) == 1 and self.chance.random() < self.faults.lost_answers
        for character in data:
            at_s += time_s
            got = None if lost_answer else self._carry(character)
            if got is not None:
                arrived.append((at_s, got))
        self.lost_answer = len(data) == 1 and bytes(c for _, c in arrived) != data
        self.busy_until_s = at_s
        self.log.append((now_s, f"{data!r} -> {bytes(c for _, c in arrived)!r}"))
        return self._in_chunks(arrived)

    def noise(self, now_s: float) -> list[tuple[float, bytes]]:
        """Return the same for noise that begins now, if the line is free."""
        if now_s < self.busy_until_s:
            return []
        data = self.chance.randbytes(self.chance.choice((1, 1, 2, 3, 8)))
        if self.options.frame.data_bits == 7:
            data = bytes(c & 0x7F if c < 0x80 else 0 for c in data)
        if self.faults.visible and (
            data in (bytes((ETX,)), bytes((EOT,))) or (self.lost_answer and data[0] in (ACK, NAK))
        ):
            return []
        time_s = self.options.character_time_s
        self.busy_until_s = now_s + len(data) * time_s
        self.log.append((now_s, f"noise {data!r}"))
        return self._in_chunks([(now_s + (i + 1) * time_s, c) for i, c in enumerate(data)])

    def _carry(self, character: int) -> int | None:
        if character in (SOH, STX):
            self.damage = 0
        if self.chance.random() < self.faults.lost:
            return None if self._mark(character) else character
        parity = self.options.frame.parity != "N"
        bits = self.options.frame.data_bits + parity
        flips = 0
        if self.faults.bit_errors and self.chance.random() < 1 - (1 - self.faults.bit_errors) ** bits:
            flips = 1 << self.chance.randrange(bits)
            if self.chance.random() < self.faults.bit_errors * bits:
                flips |= 1 << self.chance.randrange(bits)
        if not flips:
            return character
        seen = 0 if parity and flips.bit_count() % 2 else (character ^ flips) & (1 << (bits - parity)) - 1
        return seen if seen != character and self._mark(character ^ seen) else character

    def _mark(self, change: int) -> bool:
        """Note a change, unless it would hide those before."""
        if self.faults.visible and self.damage ^ change == 0:
            return False
        self.damage ^= change
        return True

    def _in_chunks(self, arrived: list[tuple[float, int]]) -> list[tuple[float, bytes]]:
        chunks = []
        while arrived:
            size = self.chance.randint(1, self.faults.chunk)
            part, arrived = arrived[:size], arrived[size:]
            chunks.append((part[-1][0], bytes(c for _, c in part)))
        return chunks


class Owner:
    """An engine with what a program does for it. LINES: what it has to send."""

    def __init__(self, engine: Engine, lines: Sequence[bytes] | None) -> None:
        self.engine = engine
        self.lines = lines
        self.given = 0
        self.received: list[bytes] = []
        self.kept: list[bytes] | None = None
        self.header: Header | None = None
        self.outcome: events.Event | None = None
        self.receive = engine.receive
        self.handle_timer = engine.handle_timer
        self.next_deadline = engine.next_deadline
        self.take_output = engine.take_output

    @property
    def is_over(self) -> bool:
        return self.engine.state is State.IDLE

    def look(self, now_s: float) -> None:
        while happened := self.engine.take_events():
            for event in happened:
                self.act(event)

    def act(self, event: events.Event) -> None:
        match event:
            case events.Asked(header=header):
                assert self.kept is None, "a second header was taken"
                self.header, self.given, self.received = header, 0, []
                self.engine.accept()
            case events.LineWanted() if self.lines is not None and self.given < len(self.lines):
                self.engine.give_line(self.lines[self.given])
                self.given += 1
            case events.LineWanted():
                self.engine.give_end()
            case events.Line(text=text):
                self.received.append(text)
                self.engine.line_taken()
            case events.Ended():
                self.kept = self.received
                self.engine.file_kept()
            case _:
                assert self.outcome is None or isinstance(event, events.Failed | events.Sent)
                self.outcome = event


@dataclass
class Line:
    """Two ends, and the wires between them; each wire has chances of its own."""

    ends: tuple[End, End]
    wires: tuple[Wire, Wire]
    chance: random.Random
    now_s: float = 0.0
    _due: list[tuple[float, int, int, bytes | None]] = field(default_factory=list)
    _last_s: list[float] = field(default_factory=lambda: [0.0, 0.0])
    _number: "itertools.count[int]" = field(default_factory=itertools.count)

    def run(self, until_s: float = LIMIT_S) -> None:
        """Go on until nothing is left to do, or both are done and the line is silent."""
        self._gather(0.0)
        while True:
            deadlines = [(d, i) for i, end in enumerate(self.ends) if (d := end.next_deadline()) is not None]
            due_s = self._due[0][0] if self._due else None
            if deadlines and (due_s is None or min(deadlines)[0] < due_s):
                at_s, who = min(deadlines)
                self.now_s = max(self.now_s, at_s)
                self.ends[who].handle_timer(self.now_s)
            elif due_s is not None:
                self._deliver()
            else:
                return
            assert self.now_s < until_s, "the two never come to an end"
            self._gather(self.now_s)
            if not self._due and all(end.is_over for end in self.ends):
                return

    def _deliver(self) -> None:
        at_s, _, to, data = heapq.heappop(self._due)
        self.now_s = max(self.now_s, at_s)
        if data is not None:
            self.ends[to].receive(data, self.now_s)
            return
        for arrives_s, noise in self.wires[to].noise(self.now_s):
            self._push(arrives_s, to, noise)

    def _gather(self, now_s: float) -> None:
        for who, end in enumerate(self.ends):
            end.look(now_s)
            if output := end.take_output():
                to = 1 - who
                faults = self.wires[to].faults
                for at_s, data in self.wires[to].send(output, now_s):
                    self._push(at_s + self.chance.random() * faults.delay_s, to, data)
                if self.chance.random() < faults.noise:
                    pause_s = self.chance.choice((0.0, 0.002, 0.05, 0.5)) * self.chance.random()
                    self._push(self.wires[to].busy_until_s + pause_s, self.chance.randrange(2), None)

    def _push(self, at_s: float, to: int, data: bytes | None) -> None:
        if data is not None:  # nothing overtakes on a wire
            self._last_s[to] = at_s = max(at_s, self._last_s[to])
        heapq.heappush(self._due, (at_s, next(self._number), to, data))

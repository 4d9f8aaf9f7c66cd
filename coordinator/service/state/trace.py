"""The motion of the last seconds: where the machine is now, and what to draw.

The motion worker adds moves, the control loop reads; both see one immutable tuple at a time: neither waits.
"""

import contextlib
from bisect import bisect_right
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, Final

from coordinator.motion.moves import (
    MOVE_BYTES,
    Move,
    begin_heights_mm,
    begin_times_s,
    copied,
    end_s,
    read_move,
    read_moves,
)
from coordinator.streaming.move_source import Planned

KEEP_S: Final = 10.0
MOVES_MAX: Final = 20_000
PIECE_MOVES: Final = 256
FRESH_MAX: Final = 256
"""Batches of moves that wait for ``take_fresh``."""
BATCHES_KEEP_S: Final = KEEP_S + 2.0
"""Commands are sent up to 1.2 s before they are due."""
BATCH_BYTES_MAX: Final = 1 << 20
"""Per node."""


@dataclass(frozen=True, slots=True)
class Moment:
    """The machine at a print time."""

    position: tuple[float, float, float, float]
    """X Y Z E in the machine's frame, mm."""
    velocity_mm_s: float
    """Along the path."""
    line: int
    """Of the program; 0: none."""
    moving: bool
    extruder_mm_s: float = 0.0
    """Of the filament, as the program has it: without pressure advance; negative: it is drawn back."""


@dataclass(frozen=True, slots=True)
class Sent:
    """What all commands that were sent add up to, by stepper; empty before the first."""

    counts: tuple[int, ...] = ()
    """Where its node will count it when they are executed, in steps."""
    clocks: tuple[int, ...] = ()
    """Its node's 64-bit clock at its last step; 0: it has none."""


class MotionTrace:
    """A ``Witness`` that keeps what was planned and sent within the last KEEP_S, bounded in size."""

    def __init__(self, nodes: int) -> None:
        self._pieces: tuple[bytes, ...] = ()
        """Moves, each piece with at least one."""
        self._batches: list[deque[tuple[float, bytes]]] = [deque() for _ in range(nodes)]
        """With ``forget_before_s`` when they were sent."""
        self._batch_bytes = [0] * nodes
        self._batches_seen = [0] * nodes
        self.sent = Sent()
        self.forget_before_s = 0.0
        """Print time; set by the control loop."""
        self._fresh: deque[bytes] = deque(maxlen=FRESH_MAX)

    # ------------------------------------------------------------------------------------ as a witness

    def see_moves(self, trapezoids: Any, count: int) -> None:
        """Copy COUNT moves, at least one; in the worker's thread."""
        new = copied(trapezoids, count)
        self._fresh.append(new)
        kept = list(self._pieces)
        while len(kept) > 1 and end_s(kept[0], -1) < self.forget_before_s:
            del kept[0]  # the last one stays: it is where the machine stands
        if kept and len(kept[-1]) + len(new) <= PIECE_MOVES * MOVE_BYTES:
            kept[-1] += new
        else:
            kept.append(new)
        while len(kept) > 1 and sum(map(len, kept)) > MOVES_MAX * MOVE_BYTES:
            del kept[0]
        self._pieces = tuple(kept)

    def see_sent(self, batches: Sequence[tuple[int, bytes]], planned: Planned) -> None:
        """Keep the newest commands of each node, and what all commands add up to."""
        for node, batch in batches:
            kept = self._batches[node]
            kept.append((self.forget_before_s, batch))
            self._batches_seen[node] += 1
            self._batch_bytes[node] += len(batch)
            while len(kept) > 1 and (
                kept[0][0] < self.forget_before_s - BATCHES_KEEP_S
                or self._batch_bytes[node] > BATCH_BYTES_MAX
            ):
                self._batch_bytes[node] -= len(kept.popleft()[1])
        self.sent = Sent(planned.steps_sent, planned.last_step_clocks)

    # --------------------------------------------------------------------------------------- to look at

    def at(self, print_time: float) -> Moment | None:
        """Return where the machine is at PRINT_TIME; None before all that is known."""
        for piece in reversed(self._pieces):
            index = bisect_right(begin_times_s(piece), print_time) - 1
            if index >= 0:
                return _moment(read_move(piece, index), print_time)
        return None

    def moves(self, since_s: float) -> list[Move]:
        """Return the moves that end after print time SINCE_S, oldest first."""
        return [move for piece in self._pieces_since(since_s) for move in read_moves(piece)]

    def heights(self, since_s: float) -> tuple[float, float] | None:
        """Return between which heights the moves begin that end after SINCE_S, mm; None: there is none."""
        found = [begin_heights_mm(piece) for piece in self._pieces_since(since_s)]
        return (min(map(min, found)), max(map(max, found))) if found else None

    def _pieces_since(self, since_s: float) -> Iterator[bytes]:
        """Yield the moves that end after print time SINCE_S, in pieces with at least one, oldest first."""
        for piece in self._pieces:
            if end_s(piece, -1) > since_s:
                begun = bisect_right(begin_times_s(piece), since_s)
                first = begun - 1 if begun and end_s(piece, begun - 1) > since_s else begun
                yield piece[first * MOVE_BYTES :]

    @property
    def fresh_batches(self) -> int:
        """How many batches of moves wait for ``take_fresh``."""
        return len(self._fresh)

    def take_fresh(self) -> bytes:
        """Return the moves that came since this was called last; of too many the newest."""
        new: list[bytes] = []
        with contextlib.suppress(IndexError):
            while True:
                new.append(self._fresh.popleft())
        return b"".join(new)

    def batches(self, node: int) -> tuple[bytes, ...]:
        """Return what was sent to a moving node, oldest first."""
        return tuple(batch for _, batch in self._batches[node])

    def batches_after(self, node: int, seen: int) -> tuple[int, tuple[bytes, ...]]:
        """Return how many batches a node has got, and of those beyond the first SEEN what is still kept."""
        total, kept = self._batches_seen[node], self._batches[node]
        return total, tuple(batch for _, batch in islice(kept, max(0, len(kept) - (total - seen)), None))


def _moment(move: Move, print_time: float) -> Moment:
    """Evaluate one move, or its end when it is over."""
    t = print_time - move.print_time
    moving = t < move.accel_s + move.cruise_s + move.decel_s
    a, c = min(t, move.accel_s), min(max(t - move.accel_s, 0.0), move.cruise_s)
    d = min(max(t - move.accel_s - move.cruise_s, 0.0), move.decel_s)
    way = move.start_v * a + move.accel * a * a / 2 + move.cruise_v * (c + d) - move.accel * d * d / 2
    speed = move.start_v + move.accel * a if t < move.accel_s else move.cruise_v - move.accel * d
    if not moving:
        speed = 0.0
    x, y, z, e = (start + ratio * way for start, ratio in zip(move.start, move.ratio, strict=True))
    return Moment((x, y, z, e), speed, move.line, moving, speed * move.ratio[3])

"""The motion of the last seconds: where the machine is now, and what to draw.

The motion worker adds moves, the control loop reads; both see one immutable tuple at a time: neither waits.
"""

import contextlib
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coordinator.motion.planner.planner import ffi_memory
from coordinator.motion.trapezoid_array import TRAPEZOID
from coordinator.streaming.move_source import Planned

KEEP_S: Final = 10.0
MOVES_MAX: Final = 20_000
PIECE_MOVES: Final = 256
FRESH_MAX: Final = 256
"""Batches of moves that wait for ``take_fresh``."""
BATCH_BYTES_MAX: Final = 1 << 20
"""Per node."""

Moves = NDArray[np.void]


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
        self._pieces: tuple[Moves, ...] = ()
        self._batches: list[deque[bytes]] = [deque() for _ in range(nodes)]
        self._batch_bytes = [0] * nodes
        self._batches_seen = [0] * nodes
        self.sent = Sent()
        self.forget_before_s = 0.0
        """Print time; set by the control loop."""
        self._fresh: deque[Moves] = deque(maxlen=FRESH_MAX)

    # ------------------------------------------------------------------------------------ as a witness

    def see_moves(self, trapezoids: Any, count: int) -> None:
        """Copy moves; in the worker's thread."""
        new = np.frombuffer(ffi_memory(trapezoids, count), TRAPEZOID).copy()
        self._fresh.append(new)
        kept = list(self._pieces)
        while len(kept) > 1 and _end_s(kept[0][-1]) < self.forget_before_s:
            del kept[0]  # the last one stays: it is where the machine stands
        if kept and len(kept[-1]) + count <= PIECE_MOVES:
            kept[-1] = _joined((kept[-1], new))
        else:
            kept.append(new)
        while len(kept) > 1 and sum(map(len, kept)) > MOVES_MAX:
            del kept[0]
        self._pieces = tuple(kept)

    def see_sent(self, batches: Sequence[tuple[int, bytes]], planned: Planned) -> None:
        """Keep the newest commands of each node, and what all commands add up to."""
        for node, batch in batches:
            kept = self._batches[node]
            kept.append(batch)
            self._batches_seen[node] += 1
            self._batch_bytes[node] += len(batch)
            while len(kept) > 1 and self._batch_bytes[node] > BATCH_BYTES_MAX:
                self._batch_bytes[node] -= len(kept.popleft())
        self.sent = Sent(planned.steps_sent, planned.last_step_clocks)

    # --------------------------------------------------------------------------------------- to look at

    def at(self, print_time: float) -> Moment | None:
        """Return where the machine is at PRINT_TIME; None before all that is known."""
        for piece in reversed(self._pieces):
            if piece[0]["print_time"] <= print_time:
                index = int(np.searchsorted(piece["print_time"], print_time, side="right")) - 1
                return _moment(piece[index], print_time)
        return None

    def moves(self, since_s: float) -> Moves:
        """Return the moves that end after print time SINCE_S, oldest first."""
        pieces = self._pieces
        every = _joined(pieces)
        ends = every["print_time"] + every["accel_s"] + every["cruise_s"] + every["decel_s"]
        kept: Moves = every[ends > since_s]
        return kept

    def heights(self, since_s: float) -> tuple[float, float] | None:
        """Return between which heights the moves begin that end after SINCE_S, mm; None: there is none."""
        found: list[NDArray[np.float64]] = []
        for piece in reversed(self._pieces):
            ends = piece["print_time"] + piece["accel_s"] + piece["cruise_s"] + piece["decel_s"]
            found.append(piece["start"][ends > since_s][:, 2])
            if ends[0] <= since_s:
                break
        every = np.concatenate(found) if found else np.empty(0)
        return (float(every.min()), float(every.max())) if len(every) else None

    @property
    def fresh_batches(self) -> int:
        """How many batches of moves wait for ``take_fresh``."""
        return len(self._fresh)

    def take_fresh(self) -> Moves:
        """Return the moves that came since this was called last; of too many the newest."""
        new: list[Moves] = []
        with contextlib.suppress(IndexError):
            while True:
                new.append(self._fresh.popleft())
        return _joined(new)

    def batches(self, node: int) -> tuple[bytes, ...]:
        """Return what was sent to a moving node, oldest first."""
        return tuple(self._batches[node])

    def batches_after(self, node: int, seen: int) -> tuple[int, tuple[bytes, ...]]:
        """Return how many batches a node has got, and of those beyond the first SEEN what is still kept."""
        total, kept = self._batches_seen[node], self._batches[node]
        return total, tuple(islice(kept, max(0, len(kept) - (total - seen)), None))


def _joined(pieces: Sequence[Moves]) -> Moves:
    """Return PIECES as one array, in a fraction of what np.concatenate takes for records."""
    return np.frombuffer(b"".join(piece.tobytes() for piece in pieces), TRAPEZOID)


def _end_s(move: Any) -> float:
    return float(move["print_time"] + move["accel_s"] + move["cruise_s"] + move["decel_s"])


def _moment(move: Any, print_time: float) -> Moment:
    """Evaluate one move, or its end when it is over."""
    fields = dict(zip(TRAPEZOID.names or (), move.item(), strict=True))  # one by one they cost three times
    t = print_time - fields["print_time"]
    accel, start_v, cruise_v = fields["accel"], fields["start_v"], fields["cruise_v"]
    accel_s, cruise_s, decel_s = fields["accel_s"], fields["cruise_s"], fields["decel_s"]
    moving = t < accel_s + cruise_s + decel_s
    a, c, d = min(t, accel_s), min(max(t - accel_s, 0.0), cruise_s), max(t - accel_s - cruise_s, 0.0)
    d = min(d, decel_s)
    way = start_v * a + accel * a * a / 2 + cruise_v * c + cruise_v * d - accel * d * d / 2
    speed = start_v + accel * a if t < accel_s else cruise_v - accel * d
    x, y, z, e = (fields["start"] + fields["ratio"] * way).tolist()
    if not moving:
        speed = 0.0
    return Moment((x, y, z, e), speed, fields["line"], moving, speed * float(fields["ratio"][3]))

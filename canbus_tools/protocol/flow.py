"""A node's flow control from listening: repeated, refused and missing blocks, and round trips. Sans-IO.

Frames that the node received may be missing from a recording, and vice versa. In ambiguous cases the more
probable explanation is counted.
"""

import math
from collections import Counter
from typing import Final

from nodes.support._wire import lib

SEQUENCE_MASK: Final[int] = lib.WIRE_SEQ_MASK
EMPTY_SIZE: Final[int] = lib.WIRE_BLOCK_MIN
REPEAT_S: Final = 10.0
"""An equal block with an equal number counts as a repeat that long; after that it may be periodic."""
RTT_MAX_S: Final = 1000.0
BUCKETS_PER_OCTAVE: Final = 16
"""Quantiles are right to 4 %."""


class RoundTrips:
    """Statistics of round trips, in bounded memory."""

    def __init__(self) -> None:
        self.count = 0
        self.min_s = math.inf
        self.max_s = 0.0
        self._buckets: Counter[int] = Counter()  # by logarithm: at most some 500

    def add(self, rtt_s: float) -> None:
        """Take one sample; what no clock could have measured is left out."""
        if not 0 <= rtt_s <= RTT_MAX_S:
            return
        self.count += 1
        self.min_s = min(self.min_s, rtt_s)
        self.max_s = max(self.max_s, rtt_s)
        self._buckets[int(math.log2(rtt_s * 1e6 + 1) * BUCKETS_PER_OCTAVE)] += 1

    def quantile_s(self, share: float) -> float:
        """Return what SHARE (0..1) of the samples do not exceed; NaN without samples."""
        rest = share * self.count
        for bucket in sorted(self._buckets):
            rest -= self._buckets[bucket]
            if rest <= 0:
                middle_s = (2 ** ((bucket + 0.5) / BUCKETS_PER_OCTAVE) - 1) / 1e6
                return min(max(middle_s, self.min_s), self.max_s)
        return math.nan

    def to_json(self) -> dict[str, float | int] | None:
        """Return count, min, median, p99 and max (seconds); None without samples."""
        if not self.count:
            return None
        return {
            "count": self.count,
            "min_s": round(self.min_s, 9),
            "median_s": round(self.quantile_s(0.5), 9),
            "p99_s": round(self.quantile_s(0.99), 9),
            "max_s": round(self.max_s, 9),
        }


class Flow:
    """Block numbers of one node, both ways. Times are seconds of one clock, whole blocks as bytes."""

    def __init__(self) -> None:
        self.repeated_blocks = 0
        """To the node, sent once more."""
        self.missed_blocks = 0
        """To the node, not seen by the onlooker and yet taken. Multiples of 16 go unnoticed."""
        self.naks = 0
        self.round_trips = RoundTrips()
        self.restart()

    def restart(self) -> None:
        """Forget all block numbers: the node starts again."""
        self._next: int | None = None
        self._flight: dict[int, float | None] = {}  # in order of sending; None: repeated, gives no round trip
        self._gaps: dict[int, int] = {}  # by number: how many before it were not seen, if the node takes it
        self._before: list[tuple[bytes, float] | None] = [None] * (SEQUENCE_MASK + 1)
        self._answered: int | None = None
        self._empty: int | None = None

    def sent(self, block: bytes, now_s: float) -> bool:
        """Take a block to the node; return whether it is a repeat."""
        number = block[1] & SEQUENCE_MASK
        before = self._before[number]
        self._before[number] = (block, now_s)
        if number != self._next:
            if before and before[0] == block and 0 <= now_s - before[1] <= REPEAT_S:
                self.repeated_blocks += 1
                if number in self._flight:
                    self._flight[number] = None
                return True
            if self._next is not None:
                self._gaps[number] = (number - self._next) & SEQUENCE_MASK
        elif self._gaps:
            self._gaps.pop(number, None)
        self._next = (number + 1) & SEQUENCE_MASK
        self._flight.pop(number, None)
        self._flight[number] = now_s
        return False

    def answered(self, block: bytes, now_s: float) -> bool:
        """Take a block from the node; return whether it is a nak."""
        following = block[1] & SEQUENCE_MASK
        last = (following - 1) & SEQUENCE_MASK
        before, self._answered = self._answered, following
        progress = last in self._flight
        if progress:
            sent_s = self._flight[last]
            self._acknowledge(last)
            if sent_s is not None:
                self.round_trips.add(now_s - sent_s)
        elif self._flight and following not in self._flight and following != before:
            return self._lose_count(first=before is None, following=following, empty=len(block) == EMPTY_SIZE)
        if len(block) > EMPTY_SIZE:
            return False
        # A second empty block with the same number refuses what is under way.
        again, self._empty = self._empty == following, following
        if progress or not again or not self._flight:
            return False
        self.naks += 1
        self._gaps.clear()
        if following not in self._flight:
            self._next = None
            self._flight.clear()
        return True

    def _lose_count(self, *, first: bool, following: int, empty: bool) -> bool:
        """Take an answer for no block in flight; return whether it is a nak.

        Either a new host started with another number than the node expects, or frames are missing from the
        recording.
        """
        self._next = None
        self._flight.clear()
        self._gaps.clear()
        if empty:
            self._empty = following
        self.naks += first
        return first

    def _acknowledge(self, last: int) -> None:
        """Everything up to number LAST was taken."""
        for number in list(self._flight):
            del self._flight[number]
            self.missed_blocks += self._gaps.pop(number, 0)
            if number == last:
                break

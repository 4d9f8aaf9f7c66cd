"""Pacing of the words and frames of a transmission: sans-IO, in host time."""

from collections import deque
from collections.abc import Iterable
from typing import Final

from nodes.mt.mt import MtError

NS_PER_S: Final = 1_000_000_000


class PacedWords:
    """WORDS one by one, DELAY_NS apart (the protocol's T), for a drive that polls a register or a slow line.

    The drive must poll at least once in T; it then sees every word.
    """

    def __init__(self, words: Iterable[int], delay_ns: int, now_ns: int) -> None:
        if delay_ns < 0:
            raise MtError(f"the delay between two words is {delay_ns} ns; give 0 or more")
        self._words = deque(words)
        self._delay_ns = delay_ns
        self.deadline_ns: int | None = now_ns if self._words else None
        """When the next word is due; None: all are sent."""

    def take(self, now_ns: int) -> int | None:
        """Return the word to be sent at NOW_NS, None while none is due.

        After a late word the next one still waits a whole delay: the drive needs it.
        """
        if self.deadline_ns is None or now_ns < self.deadline_ns:
            return None
        word = self._words.popleft()
        self.deadline_ns = now_ns + self._delay_ns if self._words else None
        return word

    def delay(self, by_ns: int) -> None:
        """Delay the next word by BY_NS, the time that the last one was in transit."""
        if self.deadline_ns is not None:
            self.deadline_ns += by_ns


class PacedFrames:
    """CAN frames within a budget of bits, so that they do not delay motion.

    COSTS[i] is the length of frame i in bits; BITS_PER_S is the frames' share of the bus. Up to BURST_BITS
    are sent at once after a pause.
    """

    def __init__(self, costs: Iterable[int], bits_per_s: float, burst_bits: int, now_ns: int) -> None:
        if not bits_per_s > 0:
            raise MtError(f"a share of {bits_per_s} bit/s of a bus; it must be above 0")
        self._costs = deque(costs)
        self._ns_per_bit = NS_PER_S / bits_per_s
        self._burst_ns = round(burst_bits * self._ns_per_bit)
        self.paid_ns = now_ns
        """Time until which the frames sent so far use up the budget."""

    @property
    def left(self) -> int:
        """How many frames are still to be sent."""
        return len(self._costs)

    @property
    def deadline_ns(self) -> int | None:
        """When the next frame is due; None: all are sent."""
        return self.paid_ns if self._costs else None

    def take(self, now_ns: int) -> int:
        """Return how many frames may be sent at NOW_NS."""
        self.paid_ns = max(self.paid_ns, now_ns - self._burst_ns)
        count = 0
        while self._costs and self.paid_ns <= now_ns:
            self.paid_ns += round(self._costs.popleft() * self._ns_per_bit)
            count += 1
        return count

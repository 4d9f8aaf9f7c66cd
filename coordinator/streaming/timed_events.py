"""What is done in time, kept until its time is near.

A program is read ahead, a dwell or a long move at once: a heater's target behind it must not act before it.
Nodes get what they do to the tick AHEAD_S before, early enough for any of them.
"""

from collections import deque
from collections.abc import Iterable
from typing import Final

from coordinator.gcode.events import AS_SOON_AS_POSSIBLE, Timed

AHEAD_S: Final = 1.6
"""The longest cycle (streamer.py), and what outputs need (modules/outputs/timing.py)."""

Due = tuple[float, Timed]
"""The print time in s at which an event takes effect; and it."""


class DueEvents:
    """Keeps the order in which the program has them.

    An event from outside the program that is wanted as soon as possible is done at once, with all that was
    read before it: a target that waits for its time must not undo that heaters were turned off.
    """

    def __init__(self) -> None:
        self._waiting: deque[Due] = deque()

    def take(self, now_s: float, new: Iterable[Due]) -> list[Due]:
        """Add NEW ones; return what is to be done at print time NOW_S."""
        least = 0
        for due in new:
            self._waiting.append(due)
            if due[1].after_moves == AS_SOON_AS_POSSIBLE:
                least = len(self._waiting)
        ready: list[Due] = []
        while self._waiting and (len(ready) < least or self._waiting[0][0] <= now_s + AHEAD_S):
            ready.append(self._waiting.popleft())
        return ready

    @property
    def waiting(self) -> int:
        """How many wait for their time."""
        return len(self._waiting)

    def rest(self) -> list[Due]:
        """Return all that still waits: nothing comes after it."""
        return self.take(float("inf"), ())

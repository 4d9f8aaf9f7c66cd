"""Turns for the connections of an HTTP server: what all of them cost in a round of the loop is bounded.

The control loop also hands motion over. FairScheduler (coordinator/ipc/server) measures the time of each
turn; here most of the work is done later, by aiohttp's tasks, so the turns themselves are counted.
"""

import asyncio
from typing import Final, Protocol

TURNS_PER_ROUND: Final = 4
"""A turn leads to one answer of the page, about 0.3 ms, or to a few messages of its WebSocket."""
RECEIVE_BYTES: Final = 16_384
"""That one connection gives at a time."""


class Worker(Protocol):
    """A connection."""

    def take_turn(self) -> bool:
        """Do a bounded part of what there is to do; return whether there is more."""
        ...


class RoundRobin:
    """Gives turns to the workers that have requested one, on the loop that makes it."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._waiting: dict[Worker, None] = {}  # in the order in which they came
        self._round_is_due = False
        self.received = memoryview(bytearray(RECEIVE_BYTES))
        """Buffer that all connections receive into; each takes its bytes at once."""

    def request_turn(self, worker: Worker) -> None:
        """Let WORKER take a turn in the next round that has one left."""
        self._waiting[worker] = None
        self._expect_round()

    def remove(self, worker: Worker) -> None:
        """Forget WORKER."""
        self._waiting.pop(worker, None)

    def _expect_round(self) -> None:
        if not self._round_is_due:
            self._round_is_due = True
            self._loop.call_soon(self._round)

    def _round(self) -> None:
        self._round_is_due = False
        for worker in list(self._waiting)[:TURNS_PER_ROUND]:
            if worker in self._waiting:
                del self._waiting[worker]
                if worker.take_turn():
                    self._waiting[worker] = None
        if self._waiting:
            self._expect_round()

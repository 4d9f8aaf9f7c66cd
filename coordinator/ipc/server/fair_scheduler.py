"""Fair shares of the control loop: however many clients request however much, its other work is in time.

The control loop also hands motion over. In each of its rounds all clients together work for ROUND_S and the
turn that reaches it; one client for TURN_S, then the others that wait come first. Who seems to have sent an
emergency stop is ahead of them, but each round also has a turn for who waits longest of the others.
"""

import asyncio
from collections.abc import Callable
from typing import Final, Protocol

ROUND_S: Final = 0.001
TURN_S: Final = 0.00025
RECEIVE_BYTES: Final = 65_536


class Worker(Protocol):
    """A client's connection."""

    transport: asyncio.Transport
    """Aborted when ``work`` raises."""

    def work(self, until_s: float) -> bool:
        """Do what there is to do, until UNTIL_S by the loop's clock; return whether there is more."""
        ...

    def pause(self) -> None:
        """Read no more until the next turn."""


class FairScheduler:
    """Shares the rounds of the loop that makes it; NOW_S is the loop's clock."""

    def __init__(self, now_s: Callable[[], float] | None = None) -> None:
        self._loop = asyncio.get_running_loop()
        self._now_s = self._loop.time if now_s is None else now_s
        self._waiting: dict[Worker, None] = {}  # in the order in which they came
        self._urgent: dict[Worker, None] = {}  # likewise, none of them in both
        self._spent_s = 0.0  # in this round, and in those before it that nobody had to wait in
        self._round_is_due = False
        self.received = memoryview(bytearray(RECEIVE_BYTES))
        """Buffer that all connections receive into; each processes it at once."""

    def request_turn(self, worker: Worker, *, urgent: bool = False) -> None:
        """Let WORKER work: now, or after those that wait; an URGENT one after those that are urgent."""
        if not (self._waiting or self._urgent or self._spent_s >= ROUND_S):
            self._run(worker)
            return
        if urgent:
            self._waiting.pop(worker, None)
            self._urgent[worker] = None
        elif worker not in self._urgent:
            self._waiting[worker] = None
        self._expect_round()
        worker.pause()

    def request_later(self, worker: Worker) -> None:
        """Let WORKER work in a round to come: who calls this is not to be interrupted by what it does."""
        if worker not in self._urgent:
            self._waiting[worker] = None
        self._expect_round()

    def remove(self, worker: Worker) -> None:
        """Forget WORKER."""
        self._waiting.pop(worker, None)
        self._urgent.pop(worker, None)

    def _run(self, worker: Worker) -> None:
        begun_s = self._now_s()
        try:
            more = worker.work(begun_s + TURN_S)
        except Exception as error:  # noqa: BLE001 (a bug of one turn must not end those of others; it is reported)
            more = False
            self._loop.call_exception_handler(
                {"message": "canductor: the turn of a client failed", "exception": error}
            )
            worker.transport.abort()
        self._spent_s += self._now_s() - begun_s
        if more:
            self._waiting[worker] = None
            self._expect_round()
        elif self._spent_s >= ROUND_S / 2:  # a round for each request would cost as much as the request
            self._expect_round()

    def _expect_round(self) -> None:
        if not self._round_is_due:
            self._round_is_due = True
            self._loop.call_soon(self._round)  # what the loop has ready by now comes before it

    def _round(self) -> None:
        self._round_is_due = False
        self._spent_s = 0.0
        for waiting in (self._urgent, self._waiting):
            self._serve(waiting)
        if self._waiting or self._urgent:
            self._expect_round()

    def _serve(self, waiting: dict[Worker, None]) -> None:
        """Let those WAITING work until the round is over, the first one in any case."""
        for number, worker in enumerate(list(waiting)):
            if number and self._spent_s >= ROUND_S:
                return
            if worker in waiting:
                del waiting[worker]
                self._run(worker)

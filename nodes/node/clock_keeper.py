"""Regular queries of one node's clock, and a check for a restart when the node goes silent."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import Final

from nodes.clock.clock import BROKEN, ClockEstimate, ClockEstimator
from nodes.clock.wire_time import narrow
from nodes.node.connector import ClockConnector
from nodes.node.request_reply import Answer, Query, QueryTimeout, RequestReply
from nodes.support.awake import Pause
from nodes.support.errors import CanductorError

CLOCK: Final = Query("get_clock", "clock")
UPTIME: Final = Query("get_uptime", "uptime")
REST_INTERVAL_S: Final = 4.0
"""At least, between two samples of a clock that is known while nothing needs it closely."""
SLACK: Final = 0.35
"""By how much of the time between two samples the next may be later: what sensors report every 0.3 s wakes
the host meanwhile."""

_BROKEN: Final = (
    f"its clock is unusable: {BROKEN} readings in a row contradict the estimate and each other; check"
    " the board's supply and its firmware"
)


class ClockKeeper:
    """Keeps the clock of the node that TALK talks with, reached through CONNECTOR, until ``close``.

    ON_ESTIMATE gets every new estimate; ON_LOST gets a sentence when the clock is no longer kept. QUERIES
    returns what else the node is to be asked at a sample, UPTIME first, or nothing; ON_ANSWERS is awaited
    with the answers, None for one that is missing, and may raise whatever RequestReply.ask raises.
    """

    def __init__(
        self,
        talk: RequestReply,
        connector: ClockConnector,
        *,
        on_estimate: Callable[[ClockEstimate], None],
        queries: Callable[[], Sequence[Query]],
        on_answers: Callable[[Sequence[Answer | None]], Awaitable[None]],
        on_lost: Callable[[str], None],
    ) -> None:
        self.estimator = ClockEstimator(talk.dictionary.clock_freq_hz)
        self.ready = asyncio.Event()
        """Set when the clock is known, or when waiting for it has become pointless."""
        self._talk = talk
        self._connector = connector
        self._on_estimate = on_estimate
        self._queries = queries
        self._on_answers = on_answers
        self._on_lost = on_lost
        self._rests = False
        self._pause = Pause()
        talk.link.on_silent = connector.suspect
        self._task = asyncio.get_running_loop().create_task(self._keep())
        self._task.add_done_callback(self._ended)

    @property
    def rests(self) -> bool:
        """Whether nothing needs the clock closely now; when that ends, it is asked as soon as it is due."""
        return self._rests

    @rests.setter
    def rests(self, rests: bool) -> None:
        if self._rests and not rests:
            self._pause.end()
        self._rests = rests

    async def close(self) -> None:
        """Stop the queries; the estimate remains. Calling it again has no effect."""
        if not self._task.done():
            self._task.cancel()
            await asyncio.wait([self._task])

    def _ended(self, task: asyncio.Task[None]) -> None:
        """Log a bug in keeping the clock and stop using the node, since its time is not known."""
        bug = None if task.cancelled() else task.exception()
        if bug is not None:
            self._on_lost("its clock is no longer kept; this is a bug, please report it")
            task.get_loop().call_exception_handler({"message": "keeping a clock failed", "exception": bug})

    async def _keep(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            asked_s = loop.time()
            try:
                await self._sample()
                if self.estimator.broken:
                    self._on_lost(_BROKEN)
                    return
            except QueryTimeout:
                self._connector.suspect()  # the link decides when a silent node is lost
            except CanductorError as error:
                self._on_lost(str(error))
                return
            interval_s = self.estimator.next_sample_ns(0) * 1e-9
            due_s = asked_s + interval_s
            if self._rests and not self.estimator.in_doubt:
                rested_s = max(asked_s + REST_INTERVAL_S, loop.time())  # the answer may have waited
                await self._pause.between(rested_s, rested_s + REST_INTERVAL_S * SLACK)
            while loop.time() < due_s:  # as well when the rest has ended before
                await self._pause.between(due_s, due_s + interval_s * SLACK)

    async def _sample(self) -> None:
        """Query the clock and what else is asked.

        A computer and a bus that are otherwise at rest wake up once when the answers come together, and the
        uptime is a reading of the clock. But where the bit rate is not known, the length of the blocks adds
        to the error of the clock: there it is queried alone.
        """
        queries = self._queries()
        if not queries or self.estimator.in_doubt or not self._is_wire_known():
            self._sampled(await self._ask())
            if self.estimator.broken or not queries:
                return
            answers = await self._talk.ask_together(queries)
        else:
            answers = await self._talk.ask_together(queries)
            if answers[0] is not None:
                self._sampled(answers[0])
        if not self.estimator.broken:
            await self._on_answers(answers)

    def _is_wire_known(self) -> bool:
        return self._connector.wire_ns(0, self._bitrate(), answer=False) > 0

    def _bitrate(self) -> int:
        return self._talk.dictionary.int_constant("CANBUS_FREQUENCY", 0)

    def _sampled(self, answer: Answer) -> None:
        if not self._take(answer):
            return
        estimate = self.estimator.estimate()
        self._talk.link.set_clock(estimate.freq_hz, estimate.at_ns, estimate.at_ticks)
        self._on_estimate(estimate)
        if self.estimator.ready:
            self.ready.set()

    async def _ask(self) -> Answer:
        query = CLOCK if self.estimator.accepted else UPTIME
        patient = not self.estimator.in_doubt
        return await self._talk.ask(*query, tries=1, survives_shutdown=True, patient=patient)

    def _take(self, answer: Answer) -> bool:
        message = answer.message
        bitrate = self._bitrate()
        sent_ns, received_ns = narrow(
            answer.sent_ns,
            answer.received_ns,
            self._connector.wire_ns(answer.asked_bytes, bitrate, answer=False),
            self._connector.wire_ns(answer.answered_bytes, bitrate, answer=True),
        )
        if self.estimator.accepted:
            return self.estimator.add(sent_ns, received_ns, message.integer("clock"))
        return self.estimator.begin(sent_ns, received_ns, message.integer("high"), message.integer("clock"))

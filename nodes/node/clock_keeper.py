"""Regular queries of one node's clock, and a check for a restart when the node goes silent."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Final

from nodes.clock.clock import BROKEN, ClockEstimate, ClockEstimator
from nodes.clock.wire_time import narrow
from nodes.node.connector import ClockConnector
from nodes.node.request_reply import Answer, QueryTimeout, RequestReply
from nodes.support.awake import sleep_between
from nodes.support.errors import CanductorError

SLACK: Final = 0.1
"""By how much of the time between two samples the next may be later."""

_BROKEN: Final = (
    f"its clock is unusable: {BROKEN} readings in a row contradict the estimate and each other; check"
    " the board's supply and its firmware"
)


class ClockKeeper:
    """Keeps the clock of the node that TALK talks with, reached through CONNECTOR, until ``close``.

    ON_ESTIMATE gets every new estimate; ON_SAMPLE is awaited after every sample and may raise whatever
    RequestReply.ask raises; ON_LOST gets a sentence when the clock is no longer kept.
    """

    def __init__(
        self,
        talk: RequestReply,
        connector: ClockConnector,
        *,
        on_estimate: Callable[[ClockEstimate], None],
        on_sample: Callable[[], Awaitable[None]],
        on_lost: Callable[[str], None],
    ) -> None:
        self.estimator = ClockEstimator(talk.dictionary.clock_freq_hz)
        self.ready = asyncio.Event()
        """Set when the clock is known, or when waiting for it has become pointless."""
        self._talk = talk
        self._connector = connector
        self._on_estimate = on_estimate
        self._on_sample = on_sample
        self._on_lost = on_lost
        talk.link.on_silent = connector.suspect
        self._task = asyncio.get_running_loop().create_task(self._keep())
        self._task.add_done_callback(self._ended)

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
        while True:
            try:
                self._sampled(await self._ask())
                if self.estimator.broken:
                    self._on_lost(_BROKEN)
                    return
                await self._on_sample()
            except QueryTimeout:
                self._connector.suspect()  # the link decides when a silent node is lost
            except CanductorError as error:
                self._on_lost(str(error))
                return
            pause_s = self.estimator.next_sample_ns(0) * 1e-9
            await sleep_between(pause_s, pause_s * (1 + SLACK))

    def _sampled(self, answer: Answer) -> None:
        if not self._take(answer):
            return
        estimate = self.estimator.estimate()
        self._talk.link.set_clock(estimate.freq_hz, estimate.at_ns, estimate.at_ticks)
        self._on_estimate(estimate)
        if self.estimator.ready:
            self.ready.set()

    async def _ask(self) -> Answer:
        if self.estimator.accepted:
            return await self._talk.ask("get_clock", "clock", tries=1, survives_shutdown=True, patient=True)
        return await self._talk.ask("get_uptime", "uptime", tries=1, survives_shutdown=True)

    def _take(self, answer: Answer) -> bool:
        message = answer.message
        bitrate = self._talk.dictionary.int_constant("CANBUS_FREQUENCY", 0)
        sent_ns, received_ns = narrow(
            answer.sent_ns,
            answer.received_ns,
            self._connector.wire_ns(answer.asked_bytes, bitrate, answer=False),
            self._connector.wire_ns(answer.answered_bytes, bitrate, answer=True),
        )
        if message.name == "clock":
            return self.estimator.add(sent_ns, received_ns, message.integer("clock"))
        return self.estimator.begin(sent_ns, received_ns, message.integer("high"), message.integer("clock"))

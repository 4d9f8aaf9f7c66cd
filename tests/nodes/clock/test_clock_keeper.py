"""Keeping the clock of one node: when it is asked, when it is suspected, and how keeping it ends."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

import pytest

from nodes.clock.clock import SETTLE_SAMPLES, ClockEstimate
from nodes.node.clock_keeper import REST_INTERVAL_S, UPTIME, ClockKeeper
from nodes.node.errors import NodeLost, NodeShutdown
from nodes.node.request_reply import Answer, Query, RequestReply
from nodes.node.watchdog import QUERIES
from tests.nodes import virtual_time
from tests.nodes.twin_bus import DELAY_S, TwinIO, TwinLink, TwinNode

BITRATE = "CANBUS_FREQUENCY"
"""Of a node's dictionary."""
OUT_NS, BACK_NS = 120_000, 150_000


class Bench:
    """A keeper over a real conversation with a twin node, and what it reported; it is its connector, too."""

    def __init__(self, **constants: int) -> None:
        self.twin = TwinNode()
        self.io = TwinIO([self.twin])
        self.talk = RequestReply("mainboard")
        self.link = TwinLink(self.io, self.twin, self.talk.receive, lambda _: None)
        self.talk.attach(self.link)
        known = {key: value for key, value in self.twin.dictionary.constants.items() if key != BITRATE}
        self.talk.dictionary = self.twin.dictionary
        self.talk.dictionary.constants = {**known, **constants}
        self.estimates: list[ClockEstimate] = []
        self.sampled_s: list[float] = []
        self.suspected_s: list[float] = []
        self.lost: list[str] = []
        self.blocks: list[tuple[int, int, bool]] = []
        self.queries: tuple[Query, ...] = ()
        self.on_answers: Callable[[], None] = lambda: None
        self.answered: list[list[str | None]] = []

    # What a connector does:

    def wire_ns(self, content_bytes: int, bitrate: int, *, answer: bool) -> int:
        self.blocks.append((content_bytes, bitrate, answer))
        return BACK_NS if answer else OUT_NS

    def suspect(self) -> None:
        self.suspected_s.append(asyncio.get_running_loop().time())

    # ------------------------------------------------------------------------------------------------------

    def _estimated(self, estimate: ClockEstimate) -> None:
        self.sampled_s.append(asyncio.get_running_loop().time())
        self.estimates.append(estimate)

    async def _answered(self, answers: Sequence[Answer | None]) -> None:
        self.answered.append([answer.message.name if answer else None for answer in answers])
        self.on_answers()

    def run(self, main: Callable[[ClockKeeper], Awaitable[None]]) -> list[dict[str, Any]]:
        """Run MAIN beside a keeper, then close it; return what the loop was told of bugs."""
        bugs: list[dict[str, Any]] = []

        async def all_of_it() -> None:
            asyncio.get_running_loop().set_exception_handler(lambda _, context: bugs.append(context))
            keeper = ClockKeeper(
                self.talk,
                self,
                on_estimate=self._estimated,
                queries=lambda: self.queries,
                on_answers=self._answered,
                on_lost=self.lost.append,
            )
            await main(keeper)
            await keeper.close()
            await keeper.close()

        virtual_time.run(all_of_it())
        return bugs

    @property
    def asked(self) -> list[str]:
        return [text.split()[0] for text in self.twin.executed]


def sleeping(seconds: float) -> Callable[[ClockKeeper], Awaitable[None]]:
    async def sleep(_: ClockKeeper) -> None:
        await asyncio.sleep(seconds)

    return sleep


def test_a_clock_is_learned_by_asking_often_and_kept_by_asking_now_and_then() -> None:
    bench = Bench()

    async def learn(keeper: ClockKeeper) -> None:
        await keeper.ready.wait()
        assert keeper.estimator.accepted == SETTLE_SAMPLES == len(bench.estimates)
        await asyncio.sleep(2.5)

    assert bench.run(learn) == []
    assert bench.asked == ["get_uptime"] + ["get_clock"] * 49
    steps_s = [b - a for a, b in zip(bench.sampled_s[:-1], bench.sampled_s[1:], strict=True)]
    intervals_s = [0.025] * 15 + [0.05] * 32 + [0.9843] * 2
    assert steps_s == pytest.approx(intervals_s, abs=1e-10)
    assert bench.link.clocks == [(e.freq_hz, e.at_ns, e.at_ticks) for e in bench.estimates]
    assert bench.lost == []
    assert bench.suspected_s == []


def test_what_else_is_asked_goes_along_where_that_makes_no_difference_to_the_clock() -> None:
    bench = Bench(**{BITRATE: 250_000})

    async def learn(keeper: ClockKeeper) -> None:
        await keeper.ready.wait()
        bench.queries = QUERIES
        await asyncio.sleep(2.5)

    assert bench.run(learn) == []
    learned = ["get_uptime"] + ["get_clock"] * (SETTLE_SAMPLES - 1)
    assert bench.asked == learned + ["get_uptime", "get_config"] * 2
    assert bench.answered == [["uptime", "config"]] * 2
    assert len(bench.link.sent) == SETTLE_SAMPLES + 2, "a block each"
    assert len(bench.estimates) == SETTLE_SAMPLES + 2, "the uptime is a reading of the clock"


def test_what_else_is_asked_comes_behind_a_clock_in_doubt() -> None:
    bench = Bench(**{BITRATE: 250_000})
    bench.queries = QUERIES
    assert bench.run(sleeping(0.04)) == []
    assert bench.asked == ["get_uptime", "get_uptime", "get_config", "get_clock", "get_uptime", "get_config"]
    assert bench.answered == [["uptime", "config"]] * 2


def test_what_else_is_asked_comes_behind_the_clock_on_a_line_of_unknown_bit_rate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench()
    monkeypatch.setattr(bench, "wire_ns", lambda *_, **__: 0)

    async def learn(keeper: ClockKeeper) -> None:
        await keeper.ready.wait()
        bench.queries = QUERIES
        bench.twin.executed.clear()
        await asyncio.sleep(1.0)

    assert bench.run(learn) == []
    assert bench.asked == ["get_clock", "get_uptime", "get_config"]
    assert bench.answered == [["uptime", "config"]]


@pytest.mark.parametrize(
    ("queries", "answered", "readings"),
    [
        ((UPTIME, Query("get_clock", "config")), ["uptime", None], 1),
        ((Query("get_clock", "uptime"), Query("get_config", "config")), [None, "config"], 0),
    ],
)
def test_an_answer_that_is_missing_is_no_reading(
    queries: tuple[Query, ...], answered: list[str | None], readings: int
) -> None:
    bench = Bench(**{BITRATE: 250_000})

    async def learn(keeper: ClockKeeper) -> None:
        await keeper.ready.wait()
        bench.queries = queries
        bench.twin.executed.clear()
        await asyncio.sleep(1.5)

    assert bench.run(learn) == []
    assert bench.answered == [answered]
    assert len(bench.estimates) == SETTLE_SAMPLES + readings


def test_a_clock_that_nothing_needs_is_asked_less_often() -> None:
    bench = Bench()

    async def learn(keeper: ClockKeeper) -> None:
        keeper.rests = True
        await keeper.ready.wait()
        await asyncio.sleep(3 * REST_INTERVAL_S + 0.5)
        keeper.rests = False
        await asyncio.sleep(2 * REST_INTERVAL_S)

    assert bench.run(learn) == []
    steps_s = [b - a for a, b in zip(bench.sampled_s[:-1], bench.sampled_s[1:], strict=True)]
    assert steps_s[SETTLE_SAMPLES - 1 :] == pytest.approx(
        [REST_INTERVAL_S] * 3 + [0.9843] * len(steps_s[SETTLE_SAMPLES + 2 :]), abs=1e-6
    )
    assert len(steps_s) >= SETTLE_SAMPLES + 5


@pytest.mark.parametrize(("rested_s", "asked_s"), [(0.5, 0.9843), (2.0, 2.0)])
def test_a_clock_that_is_needed_again_is_asked_when_it_is_due(rested_s: float, asked_s: float) -> None:
    bench = Bench()
    woken_s: list[float] = []

    async def learn(keeper: ClockKeeper) -> None:
        keeper.rests = True
        await keeper.ready.wait()
        await asyncio.sleep(REST_INTERVAL_S + 0.1)
        asked_last_s = bench.sampled_s[-1]
        await asyncio.sleep(rested_s - 0.1)
        keeper.rests = False
        await asyncio.sleep(REST_INTERVAL_S)
        woken_s.extend(second - asked_last_s for second in bench.sampled_s if second > asked_last_s)

    assert bench.run(learn) == []
    assert woken_s[:1] == pytest.approx([asked_s], abs=1e-3)


def test_only_a_clock_in_doubt_is_in_a_hurry() -> None:
    bench = Bench()
    bench.talk.let_wait("clock", 0.1)

    async def learn(keeper: ClockKeeper) -> None:
        await keeper.ready.wait()
        assert bench.link.hurries == [True, False] * SETTLE_SAMPLES
        await asyncio.sleep(2.5)

    assert bench.run(learn) == []
    assert bench.link.hurries == [True, False] * SETTLE_SAMPLES


def test_the_time_on_the_wire_is_taken_off_the_exchange() -> None:
    bench = Bench(**{BITRATE: 250_000})
    bench.run(sleeping(0.1))
    first = bench.link.sent[0][0]
    assert bench.blocks[0] == (len(first), 250_000, False)
    content_bytes, bitrate, is_answer = bench.blocks[1]
    assert (bitrate, is_answer) == (250_000, True)
    assert content_bytes > len(first)
    trip_s = 2 * DELAY_S - (OUT_NS + BACK_NS) * 1e-9
    assert bench.estimates[0].asymmetry_s == pytest.approx(trip_s / 2, rel=1e-6)
    middle_s = bench.sampled_s[0] - DELAY_S + (OUT_NS - BACK_NS) * 0.5e-9
    assert bench.estimates[0].at_ns * 1e-9 == pytest.approx(middle_s, abs=1e-8)


def test_where_the_bit_rate_is_unknown_that_is_what_the_connector_hears() -> None:
    bench = Bench()
    bench.run(sleeping(0.01))
    assert [block[1] for block in bench.blocks] == [0, 0]


def test_a_node_that_does_not_answer_is_suspected_and_asked_again() -> None:
    bench = Bench()
    bench.twin.alive = False
    bench.run(sleeping(0.85))
    times_s = [t - virtual_time.START_S for t in bench.suspected_s]
    assert times_s == pytest.approx([0.25, 0.5, 0.75], abs=1e-6)
    assert bench.estimates == []
    assert bench.lost == []


def test_an_answer_of_unknown_times_is_not_used() -> None:
    bench = Bench()

    async def main(keeper: ClockKeeper) -> None:
        await asyncio.sleep(0.01)
        bench.queries = QUERIES
        known = len(bench.estimates)
        bench.twin.alive = False
        await asyncio.sleep(0.02)
        bench.link.say(bench.twin.response("clock", clock=5))  # a repeated block carries no time
        await asyncio.sleep(0.01)
        assert keeper.estimator.unusable == 1
        assert len(bench.estimates) == known == len(bench.link.clocks)
        assert bench.suspected_s == [], "it is a sign of life nevertheless"
        assert len(bench.link.sent) == known + 2, "and what else is asked follows"

    bench.run(main)


def test_a_node_of_whose_silence_the_link_tells_is_suspected() -> None:
    bench = Bench()

    async def main(keeper: ClockKeeper) -> None:
        await keeper.ready.wait()
        assert bench.suspected_s == []
        bench.link.on_silent()
        assert len(bench.suspected_s) == 1

    bench.run(main)


def test_when_the_conversation_fails_keeping_the_clock_is_over() -> None:
    bench = Bench()
    bench.twin.alive = False

    async def main(keeper: ClockKeeper) -> None:
        await asyncio.sleep(0.1)
        bench.talk.fail(NodeLost("it does not answer"))
        await asyncio.sleep(3)
        assert not keeper.ready.is_set()

    assert bench.run(main) == []
    assert bench.lost == ["it does not answer"]
    assert len(bench.link.sent) == 1


def test_a_shutdown_of_the_node_is_no_reason_to_lose_its_clock() -> None:
    bench = Bench()

    async def main(_: ClockKeeper) -> None:
        await asyncio.sleep(0.0001)  # now it is asked for its uptime
        bench.talk.fail(NodeShutdown("it stopped"), shutdown=True)
        await asyncio.sleep(0.0259)  # ... and now for its clock
        bench.talk.fail(NodeShutdown("it stopped"), shutdown=True)
        await asyncio.sleep(0.01)
        assert bench.asked == ["get_uptime", "get_clock"]
        assert len(bench.estimates) == 2

    bench.run(main)
    assert bench.lost == []


def test_a_bug_is_reported_and_the_node_given_up() -> None:
    bench = Bench()
    bug = ZeroDivisionError()

    def fail() -> None:
        raise bug

    bench.queries, bench.on_answers = QUERIES, fail
    bugs = bench.run(sleeping(1.0))
    assert [context["exception"] for context in bugs] == [bug]
    assert [text.split(";")[0] for text in bench.lost] == ["its clock is no longer kept"]
    assert len(bench.sampled_s) == 1


def test_closing_is_no_loss() -> None:
    bench = Bench()
    assert bench.run(sleeping(0.3)) == []
    assert bench.lost == []

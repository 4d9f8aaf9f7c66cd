"""The estimate of a clock to the figure: which exchanges count, when it begins again, what it publishes."""

import math
import random

import pytest

from nodes.clock.blend import Blend
from nodes.clock.clock import ClockEstimate, ClockEstimator, HostTime, Ticks
from nodes.clock.fit import Filter
from nodes.clock.start import Start

FREQ_HZ = 100_000_000
"""A tick lasts 10 ns."""
SECOND_NS = 1_000_000_000
TRIP_NS = 400_000
WHOLE = 1 << 32
FIRST_TICKS = (7 << 32) + 123


class Exact:
    """An estimator, and a clock without any fault that it samples over ways that take equally long."""

    def __init__(self) -> None:
        self.estimator = ClockEstimator(FREQ_HZ)
        self.now_ns = 10 * SECOND_NS
        assert self.take(begin=True)

    def ticks(self, at_ns: int) -> int:
        return FIRST_TICKS + (at_ns - 10 * SECOND_NS) // 10

    def take(self, *, trip_ns: int = TRIP_NS, wrong_ticks: int = 0, begin: bool = False) -> bool:
        """Exchange now, with an answer that is wrong by WRONG_TICKS."""
        sent_ns, received_ns = self.now_ns - trip_ns // 2, self.now_ns + trip_ns // 2
        clock = self.ticks(self.now_ns) + wrong_ticks
        if begin:
            return self.estimator.begin(sent_ns, received_ns, clock >> 32, clock % WHOLE)
        return self.estimator.add(sent_ns, received_ns, clock % WHOLE)

    def follow(self, samples: int, step_ns: int = 50_000_000) -> None:
        """Take SAMPLES more."""
        for _ in range(samples):
            self.now_ns += step_ns
            assert self.take()

    @property
    def error_s(self) -> float:
        return self.estimator.estimate().error_s

    @property
    def knows_nothing(self) -> bool:
        """Whether the last answer is all there is: the rate has 4 times 150 ppm on either side."""
        return self.error_s > 600e-6


# ---------------------------------------------------------------------------------------------------- figures


def test_what_an_estimate_says() -> None:
    estimate = ClockEstimate(2e9, HostTime(5000), Ticks(70), 3e-6, 4e-6)
    assert estimate.bound_s == 7e-6
    assert ClockEstimate(2e9, HostTime(5000), Ticks(70), 3e-6).bound_s == 3e-6
    assert estimate.ticks_at(HostTime(5100)) == 270
    assert estimate.ticks_at(HostTime(4990)) == 50
    assert estimate.ns_at(Ticks(270)) == 5100
    assert estimate.ns_at(Ticks(70 + 4 * 10**18)) == 5000 + 2 * 10**18


def test_when_the_node_is_asked_again() -> None:
    """16 exchanges in a burst, 48 until it is ready, then one about every second."""
    new = ClockEstimator(FREQ_HZ)
    assert (new.accepted, new.unusable, new.ready) == (0, 0, False)
    exact = Exact()
    intervals = []
    for count in range(1, 50):
        assert exact.estimator.accepted == count
        assert exact.estimator.ready is (count >= 48)
        intervals.append(exact.estimator.next_sample_ns(1_000) - 1_000)
        exact.follow(1)
    assert intervals == [25_000_000] * 15 + [50_000_000] * 32 + [984_300_000] * 2


def test_the_first_64_exchanges_are_fitted_together_and_then_filtered() -> None:
    """... by what the tests of those prove; the bound is 4 standard deviations, now or in a second."""
    rng = random.Random(2)
    estimator, start = ClockEstimator(FREQ_HZ), Start()
    blend: Blend | None = None
    now_ns = zero_ns = 0
    for count in range(1, 100):
        now_ns += 500_000_000
        out_ns, back_ns = (100_000 + round(rng.expovariate(1 / 30_000)) for _ in range(2))
        if count > 70:
            back_ns += 300_000  # a way that is slower: its difference to the other fades
        if count == 1:
            zero_ns = now_ns + (out_ns + back_ns) // 2
        read = FIRST_TICKS + round((now_ns + out_ns) * (1 + 50e-6)) // 10
        if count == 1:
            first = read
            assert estimator.begin(now_ns, now_ns + out_ns + back_ns, read >> 32, read % WHOLE)
        else:
            assert estimator.add(now_ns, now_ns + out_ns + back_ns, read % WHOLE)
        middle_ns = now_ns + (out_ns + back_ns) // 2
        at_s = (middle_ns - zero_ns) * 1e-9
        exchange = at_s, (read - first) / FREQ_HZ - at_s, (out_ns + back_ns) * 1e-9
        faded_s = 0.0
        if blend is None:
            state, covariance = start.add(*exchange)
        else:
            blend.add(*exchange)
            state, covariance, faded_s = blend.state, blend.covariance, blend.faded_s
        if count == 64:
            blend = Blend(Filter(state, covariance, at_s, start.spread_s))
        (a, b), (_, c) = (row[:2] for row in covariance[:2])
        found = estimator.estimate()
        assert found.freq_hz == pytest.approx(FREQ_HZ * (1 + state[1]), rel=1e-12)
        assert found.at_ns == middle_ns
        assert found.at_ticks == first + round((at_s + state[0]) * FREQ_HZ)
        assert found.error_s == pytest.approx(4 * math.sqrt(max(a, a + 2 * b + c)) + faded_s + 1e-6, rel=1e-9)
    assert faded_s > 0


# -------------------------------------------------------------------------------------------- what is refused


def test_an_exchange_of_unsound_times_changes_nothing() -> None:
    exact = Exact()
    exact.follow(3)
    before = exact.estimator.estimate()
    at_ns = before.at_ns
    for count, (sent_ns, received_ns) in enumerate(
        [
            (0, at_ns + SECOND_NS),
            (-5, at_ns + SECOND_NS),
            (at_ns + SECOND_NS, at_ns + SECOND_NS),
            (at_ns + SECOND_NS + 1, at_ns + SECOND_NS),
            (at_ns - 50, at_ns + 50),  # its middle is the last one's
            (at_ns - 50, at_ns + 51),
            (at_ns - 60, at_ns + 50),
        ],
        1,
    ):
        assert not exact.estimator.add(sent_ns, received_ns, 5)
        assert exact.estimator.unusable == count
    assert exact.estimator.accepted == 4
    assert exact.estimator.estimate() == before
    assert exact.estimator.add(at_ns - 50, at_ns + 52, exact.ticks(at_ns + 1) % WHOLE)
    assert ClockEstimator(FREQ_HZ).begin(1, 2, 0, 5)  # the first nanosecond of all


def test_a_reset_is_over_with_the_first_usable_answer() -> None:
    exact = Exact()
    exact.follow(3)
    assert not exact.estimator.begin(0, SECOND_NS, 0, 5)
    assert exact.estimator.accepted == 0
    with pytest.raises(RuntimeError):
        exact.estimator.estimate()
    assert exact.estimator.begin(500, 900, 3, 5)  # of whatever time
    estimate = exact.estimator.estimate()
    assert (estimate.at_ns, estimate.at_ticks) == (700, 3 * WHOLE + 5)
    assert exact.estimator.ns_at(Ticks(3 * WHOLE + 5)) == 700


def test_only_the_last_160_exchanges_are_remembered() -> None:
    estimator = ClockEstimator(FREQ_HZ)
    assert estimator.round_trip_s == 0.0
    exact = Exact()
    exact.follow(5)
    exact.now_ns += SECOND_NS
    assert exact.take(trip_ns=TRIP_NS // 2)
    fastest_s = TRIP_NS / 2 * 1e-9
    for _ in range(159):
        exact.follow(1)
        assert exact.estimator.round_trip_s == pytest.approx(fastest_s)
        assert exact.estimator.estimate().asymmetry_s == pytest.approx(fastest_s / 2)
    exact.follow(1)
    assert exact.estimator.round_trip_s == pytest.approx(TRIP_NS * 1e-9)


# --------------------------------------------------------------------------------------- when it begins again


def test_impossible_answers_in_a_row_that_agree_begin_the_estimate_again() -> None:
    exact = Exact()
    assert exact.knows_nothing
    exact.follow(63)

    def take_wrong(seconds: int, *, trip_ns: int = TRIP_NS) -> bool:
        exact.now_ns += SECOND_NS
        before = exact.estimator.estimate()
        taken = exact.take(wrong_ticks=seconds * FREQ_HZ, trip_ns=trip_ns)
        after = exact.estimator.estimate()
        assert taken or after == before, "what is impossible changes nothing"
        assert not taken or after.at_ticks == exact.ticks(exact.now_ns) + seconds * FREQ_HZ
        return taken

    assert [take_wrong(1) for _ in range(3)] == [False, False, False]
    assert exact.estimator.unusable == 3
    exact.follow(1)  # a possible one between
    assert [take_wrong(1) for _ in range(3)] == [False, False, False]
    assert take_wrong(1, trip_ns=2 * TRIP_NS)
    assert exact.estimator.round_trip_s == pytest.approx(2 * TRIP_NS * 1e-9)
    assert [take_wrong(9) for _ in range(4)] == [False, False, False, True]  # counted from 0 again
    assert exact.knows_nothing


def test_impossible_answers_that_contradict_each_other_are_no_clock() -> None:
    exact = Exact()
    exact.follow(63)
    known = exact.estimator.estimate()

    def take_wrong(wrong_ns: int) -> None:
        exact.now_ns = exact.estimator.next_sample_ns(exact.now_ns)
        assert not exact.estimator.broken
        assert not exact.take(wrong_ticks=wrong_ns // 10)
        assert exact.estimator.estimate() == known

    for count in range(7):
        take_wrong(SECOND_NS + count % 2 * 2 * TRIP_NS)
    exact.follow(1)
    known = exact.estimator.estimate()
    begun_ns = exact.now_ns
    for count in range(8):
        take_wrong(SECOND_NS + count % 2 * 2 * TRIP_NS)
    assert exact.estimator.broken
    assert exact.now_ns - begun_ns == 984_300_000 + 7 * 50_000_000, "asked again soon while it is in doubt"


@pytest.mark.parametrize("direction", [1, -1])
def test_impossible_answers_agree_within_their_exchanges_and_what_a_rate_may_be_off(direction: int) -> None:
    for inside, agree in ((0.98, True), (1.02, False)):
        exact = Exact()
        exact.follow(63)
        for count in range(4):
            exact.now_ns += SECOND_NS
            # The last one is compared to the first, 3 s before: half of both exchanges, and 150 ppm.
            apart_ns = round(direction * inside * (TRIP_NS + 450_000)) if count == 3 else 0
            taken = exact.take(wrong_ticks=(SECOND_NS + apart_ns) // 10)
            assert taken is (agree and count == 3)


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("age_s", [0.1, 3.0])
def test_an_answer_is_possible_within_its_exchange_and_the_bound_which_grows_with_age(
    direction: int, age_s: float
) -> None:
    """... by as much again in every second."""
    for inside, restarts in ((0.98, False), (1.02, True)):
        exact = Exact()
        exact.follow(3)
        for count in range(4):
            exact.now_ns = exact.estimator.estimate().at_ns + round(age_s * SECOND_NS)
            estimate = exact.estimator.estimate()
            trip_ns = round(estimate.error_s * 1e9)
            allowed_s = trip_ns / 2 * 1e-9 + estimate.error_s * (1 + age_s)
            there = estimate.ticks_at(HostTime(exact.now_ns)) + round(
                direction * inside * allowed_s * FREQ_HZ
            )
            taken = exact.take(wrong_ticks=there - exact.ticks(exact.now_ns), trip_ns=trip_ns)
            assert taken is (not restarts or count == 3)
            begun_again = exact.estimator.estimate().freq_hz == FREQ_HZ  # the nominal rate
            assert begun_again is (restarts and count == 3)


def test_a_silence_of_ten_minutes_is_bridged_and_a_longer_one_is_not() -> None:
    for silence_ns, restarts in ((600 * SECOND_NS, False), (600 * SECOND_NS + 1, True)):
        exact = Exact()
        exact.follow(70, step_ns=SECOND_NS)
        exact.now_ns += silence_ns - exact.now_ns + exact.estimator.estimate().at_ns
        assert exact.take(trip_ns=TRIP_NS)
        assert exact.knows_nothing is restarts

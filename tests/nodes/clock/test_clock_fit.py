"""The clock's filters in closed form, against the same by matrices and integrals (clock_reference.py)."""

import math
import random
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from nodes.clock.blend import Blend
from nodes.clock.fit import Filter, hazard, log_share
from nodes.clock.start import Start
from tests.nodes.bounds import Array
from tests.nodes.clock_reference import BlendByMatrices, FilterByMatrices, StartByRows

Exchange = tuple[float, float, float]
Delays = Callable[[float, random.Random], tuple[float, float]]
"""Ways out and back (s) of a question asked at a moment (s)."""

STATE = [2e-6, 3e-6, 2e-9, 150e-6]
COVARIANCE = [
    [4e-12, 1e-12, 1e-16, -1e-12],
    [1e-12, 9e-12, 2e-15, 1e-13],
    [1e-16, 2e-15, 5e-17, 0.0],
    [-1e-12, 1e-13, 0.0, 16e-12],
]
BASE_S, MEAN_S = 150e-6, 20e-6


def ordinary(_: float, rng: random.Random) -> tuple[float, float]:
    return BASE_S + rng.expovariate(1 / MEAN_S), BASE_S + rng.expovariate(1 / MEAN_S)


def changing(t: float, rng: random.Random) -> tuple[float, float]:
    """Return what is late now and then, then slower one way, then faster both ways."""
    out_s, back_s = ordinary(t, rng)
    if int(t) % 23 == 7:
        out_s += 40 * MEAN_S
    if int(t) % 37 == 11:
        back_s += 6.5 * MEAN_S
    if 60 < t < 100:
        back_s += 8 * MEAN_S
    if 100 <= t < 140:
        out_s += 5 * MEAN_S
    if t > 180:
        out_s, back_s = out_s - 80e-6, back_s - 70e-6
    return out_s, back_s


def exchanges(
    delays: Delays, until_s: float, *, step_s: float = 0.9, bend: float = 2e-9, bends_from_s: float = 0.0
) -> Iterator[Exchange]:
    """Yield exchanges with a clock fast by 3 ppm, and by BEND per second more from BENDS_FROM_S on."""
    rng = random.Random(4)
    t = step_s
    while t < until_s:
        out_s, back_s = delays(t, rng)
        lead_s = 2e-6 + 3e-6 * t + bend * max(t - bends_from_s, 0) ** 2 / 2
        yield t, lead_s + (out_s - back_s) / 2, out_s + back_s
        t += step_s * rng.uniform(0.9, 1.1)


def check_same(
    found: list[list[float]] | list[float], wanted: Array, scale: Array, share: float = 1e-6
) -> None:
    """Check that FOUND is WANTED within a SHARE of SCALE."""
    assert float(np.max(np.abs(np.array(found) - wanted) / scale)) < share


def both_filters(spread_s: float = 18e-6) -> tuple[Filter, FilterByMatrices]:
    grown = np.zeros((5, 5))
    grown[:4, :4] = COVARIANCE
    return (
        Filter(STATE, COVARIANCE, 0.0, spread_s),
        FilterByMatrices(np.array([*STATE, 0.0]), grown, 0.0, spread_s),
    )


def check_filters(one: Filter, other: FilterByMatrices, share: float = 1e-6) -> None:
    deviation = np.sqrt(np.maximum(np.diag(other.covariance), 1e-30))
    check_same(one.state, other.state, deviation, share)
    check_same(one.covariance, other.covariance, np.outer(deviation, deviation), share)
    assert one.faded_s == pytest.approx(other.faded_s, rel=1e-6, abs=1e-15)


# ---------------------------------------------------------------------------------------- normal distribution


def mills(k: float) -> float:
    """Return Φ(k)/φ(k) by integration."""
    points, weights = np.polynomial.legendre.leggauss(80)
    top = 12 + max(k, 0.0) if k > -8 else 60 / -k
    u = top * (1 + points) / 2
    return float((weights * np.exp(k * u - u * u / 2)).sum()) * top / 2


@pytest.mark.parametrize("k", [-25.0, -24.0, -10.0, -3.0, -0.5, 0.0, 0.7, 3.0])
def test_hazard_and_share_of_the_normal_distribution(k: float) -> None:
    assert hazard(k) == pytest.approx(1 / mills(k), rel=1e-10)
    log_density = -k * k / 2 - math.log(2 * math.pi) / 2
    assert log_share(k) == pytest.approx(log_density + math.log(mills(k)), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("k", [-25.1, -30.0, -300.0])
def test_far_below_the_mean_a_series_is_as_good(k: float) -> None:
    """... where the density itself is no number any more."""
    assert hazard(k) == pytest.approx(-k - 1 / k + 2 / k**3 - 10 / k**5, rel=1e-15)
    assert hazard(k) == pytest.approx(1 / mills(k), rel=1e-8)
    # What is left of a variance that a bound cuts so deep: a narrow exponential distribution.
    r = hazard(k)
    assert k * k * (1 - r * (k + r)) == pytest.approx(1 - 6 / k**2, rel=2e-4)
    assert log_share(k) == pytest.approx(-k * k / 2 - math.log(-k) - math.log(2 * math.pi) / 2, rel=1e-15)


def test_far_above_the_mean_nothing_is_at_hazard() -> None:
    assert hazard(1e3) == 0.0
    assert hazard(math.inf) == 0.0
    assert log_share(40.0) == 0.0


# --------------------------------------------------------------------------------------------------- filters


@pytest.mark.parametrize("delays", [ordinary, changing])
@pytest.mark.parametrize("steady", [False, True])
def test_a_filter_is_what_matrices_and_integrals_make_of_the_bounds(delays: Delays, *, steady: bool) -> None:
    one, other = both_filters()
    if steady:
        one, other = one.steady(), other.steady()
    for exchange in exchanges(delays, 260.0):
        assert one.add(*exchange) == pytest.approx(other.add(*exchange), rel=1e-6, abs=1e-6)
        check_filters(one, other)


@pytest.mark.parametrize("way", [0, 1])
def test_a_way_that_turns_slower_twice_is_noticed_after_16_exchanges_each_time(way: int) -> None:
    """... from the very first one on."""
    one, other = both_filters()
    rng = random.Random(8)
    for count in range(36):
        delays = [BASE_S + rng.expovariate(1 / MEAN_S) for _ in range(2)]
        delays[way] = BASE_S + (8 if count < 16 else 20) * MEAN_S
        exchange = 0.9 * (count + 1), (delays[0] - delays[1]) / 2, sum(delays)
        one.add(*exchange)
        other.add(*exchange)
        check_filters(one, other)
    assert all(len(gaps) < 16 for gaps in other.nearest.values())


def test_what_lies_within_the_noise_of_reading_is_no_reason_to_doubt() -> None:
    one = Filter([0.0, 0.0, 0.0, BASE_S], np.diag([1e-18, 1e-18, 1e-18, 1e-18]).tolist(), 0.0, MEAN_S)
    other = FilterByMatrices(np.array([0, 0, 0, BASE_S, 0]), np.diag([1e-18] * 4 + [0]), 0.0, MEAN_S)
    for _ in range(4):
        one.add(0.0, -0.3e-6, 2 * BASE_S)
        other.add(0.0, -0.3e-6, 2 * BASE_S)
        check_filters(one, other)


def test_a_filter_without_any_jitter_trusts_no_bound_better_than_a_tenth_of_a_microsecond() -> None:
    """... and is left with the variance of an exponential distribution, not with none."""
    one, other = both_filters(spread_s=1.001e-7)
    for exchange in exchanges(lambda t, _: (BASE_S, BASE_S + 1e-9 * math.sin(t)), 20.0, bend=0.0):
        one.add(*exchange)
        other.add(*exchange)
        check_filters(one, other, share=1e-3)


def test_a_steady_filter_shares_nothing_with_the_one_it_was_made_from() -> None:
    one, other = both_filters()
    for exchange in exchanges(changing, 100.0):
        one.add(*exchange)
        other.add(*exchange)
    steady, steady_other = one.steady(), other.steady()
    for exchange in exchanges(changing, 200.0):
        if exchange[0] > 100.0:
            steady.add(*exchange)
            steady_other.add(*exchange)
    check_filters(steady, steady_other)
    check_filters(one, other)
    for exchange in exchanges(changing, 200.0):
        if exchange[0] > 100.0:
            one.add(*exchange)
            other.add(*exchange)
    check_filters(one, other)


def test_a_blend_weighs_two_filters_by_what_they_foretold() -> None:
    filter_, other_filter = both_filters()
    one, other = Blend(filter_), BlendByMatrices(other_filter)
    assert one.state == STATE[:2]
    assert one.covariance == [row[:2] for row in COVARIANCE[:2]]
    odds: list[float] = []
    for exchange in exchanges(ordinary, 600.0, step_s=4.0, bend=1.5e-8, bends_from_s=400.0):
        one.add(*exchange)
        mean, covariance = other.add(*exchange)
        odds.append(other.odds)
        deviation = np.sqrt(np.diag(covariance))
        check_same(one.state, mean, deviation)
        check_same(one.covariance, covariance, np.outer(deviation, deviation))
        faded_s = max(abs(other.warming.faded_s), abs(other.steady.faded_s))
        assert one.faded_s == pytest.approx(faded_s, rel=1e-6, abs=1e-15)
    assert other.begun_again > 0
    assert max(odds) == 1.0


# --------------------------------------------------------------------------------------------------- start


def uneven(t: float, rng: random.Random) -> tuple[float, float]:
    """Return a very late first exchange, ordinary ones, and some far off in one direction."""
    out_s, back_s = ordinary(t, rng)
    if t < 0.02:
        back_s += 12e-3
    if rng.random() < 0.1:
        out_s += 15 * MEAN_S
    return out_s, back_s


@pytest.mark.parametrize("delays", [ordinary, uneven])
def test_the_start_is_expectation_propagation_over_all_bounds(delays: Delays) -> None:
    one, other = Start(), StartByRows()
    assert (one.samples, one.spread_s) == (0, 0.0)
    for count, exchange in enumerate(exchanges(delays, 1.2, step_s=0.05, bend=1e-6), 1):
        state, covariance = one.add(*exchange)
        wanted, wanted_covariance = other.add(*exchange)
        deviation = np.sqrt(np.diag(wanted_covariance))
        check_same(state, wanted, deviation, 1e-5)
        check_same(covariance, wanted_covariance, np.outer(deviation, deviation), 1e-5)
        assert one.spread_s == pytest.approx(other.spread_s, rel=1e-6)
        assert one.samples == count


def test_of_exchanges_that_are_equally_fast_the_first_one_says_where_to_look() -> None:
    one, other = Start(), StartByRows()
    for exchange in ((0.1, 40e-6, 300e-6), (0.2, -40e-6, 300e-6), (0.3, 0.0, 290e-6), (0.4, 9e-6, 290e-6)):
        state, _ = one.add(*exchange)
        wanted, wanted_covariance = other.add(*exchange)
        check_same(state, wanted, np.sqrt(np.diag(wanted_covariance)), 1e-4)


def test_a_bound_that_says_all_there_is_known_is_not_taken_for_what_others_say() -> None:
    """After a silence only one direction was quick: its factor makes up the belief but for a thousandth."""
    one, other = Start(), StartByRows()
    for exchange in ((0.0, 0.0, 300e-6), (100.0, -1e-3, 2.3e-3), (101.0, -1e-3, 2.3e-3)):
        state, covariance = one.add(*exchange)
        wanted, wanted_covariance = other.add(*exchange)
        deviation = np.sqrt(np.diag(wanted_covariance))
        check_same(state, wanted, deviation, 1e-3)
        check_same(covariance, wanted_covariance, np.outer(deviation, deviation), 1e-3)


def test_the_start_expects_some_jitter_even_where_it_saw_none() -> None:
    one, quick = Start(), Start()
    for count in range(1, 9):
        one.add(0.05 * count, 0.0, 300e-6)
        quick.add(0.05 * count, 0.0, 3e-6)
        if count < 6:
            assert one.spread_s == pytest.approx(50e-6 if count < 3 else 6e-6)
            assert quick.spread_s == pytest.approx(0.5e-6 if count < 3 else 1e-7)
    assert quick.spread_s == 1e-7

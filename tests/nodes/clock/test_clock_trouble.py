"""The clock estimate in trouble: bad series, slower ways, late wake-ups, odd input, temperature."""

import math
import random
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodes.clock.clock import ClockEstimator, HostTime
from tests.nodes import clock_traces as traces
from tests.profiles import examples

FREQ_HZ = 168_000_000
RATE = 1 + 50e-6
Late = Callable[[float], tuple[float, float]]
"""What comes on top of the delays out and back (s) of a question asked at a moment (s)."""


def follow(
    late: Late, seconds: float, *, seed: int = 1, floor_s: float = 0.0
) -> list[tuple[float, float, float]]:
    """Return (moment, true error a second later, published bound) of every sample."""
    rng, estimator, found = random.Random(seed), ClockEstimator(FREQ_HZ), []
    now_ns = 1_000_000_000
    while now_ns < seconds * 1e9:
        out_s, back_s = (150e-6 + rng.expovariate(1e4) + more for more in late(now_ns * 1e-9))
        back_s += rng.uniform(0, floor_s)
        read_ns = now_ns + round(out_s * 1e9)
        ticks = round(read_ns * 1e-9 * FREQ_HZ * RATE)
        if estimator.accepted:
            estimator.add(now_ns, read_ns + round(back_s * 1e9), ticks % (1 << 32))
        else:
            estimator.begin(now_ns, read_ns + round(back_s * 1e9), ticks >> 32, ticks % (1 << 32))
        then_ns = HostTime(now_ns + 1_000_000_000)
        error_s = (estimator.ticks_at(then_ns) - then_ns * 1e-9 * FREQ_HZ * RATE) / FREQ_HZ
        found.append((now_ns * 1e-9, error_s, estimator.estimate().error_s))
        now_ns = estimator.next_sample_ns(now_ns)
    return found


def worst(found: list[tuple[float, float, float]], from_s: float) -> float:
    return max(abs(error_s) for t, error_s, _ in found if t >= from_s)


def test_twenty_bad_samples_in_a_row() -> None:
    found = follow(lambda t: (12e-3 if 100 < t < 120 else 0.0, 0.0), 250)
    assert worst(found, 100) < 60e-6
    assert worst(found, 200) < 30e-6


def test_both_ways_slower_for_good() -> None:
    found = follow(lambda t: (400e-6, 400e-6) if t > 100 else (0.0, 0.0), 400)
    assert worst(found, 100) < 60e-6
    assert all(abs(error_s) <= bound_s for _, error_s, bound_s in found)


@pytest.mark.parametrize("way", [0, 1])
def test_one_way_slower_for_good_moves_the_clock_by_no_more_than_asymmetry_can(way: int) -> None:
    found = follow(lambda t: (400e-6 * (1 - way), 400e-6 * way) if t > 100 else (0.0, 0.0), 500)
    assert worst(found, 100) < 260e-6
    assert sum(abs(error_s) > bound_s for _, error_s, bound_s in found) <= 0.003 * len(found)


def test_wake_ups_late_by_ten_microseconds_leave_the_rate_good() -> None:
    rates = []
    for seed in range(20):
        rng = random.Random(seed)
        estimator, now_ns = ClockEstimator(FREQ_HZ), 1_000_000_000
        while now_ns < 3_000_000_000:
            out_s, back_s = (60e-6 + rng.expovariate(1 / 30e-6) + rng.uniform(0, 10e-6) for _ in range(2))
            read_ns = now_ns + round(out_s * 1e9)
            ticks = round(read_ns * 1e-9 * FREQ_HZ * RATE)
            if estimator.accepted:
                estimator.add(now_ns, read_ns + round(back_s * 1e9), ticks % (1 << 32))
            else:
                estimator.begin(now_ns, read_ns + round(back_s * 1e9), ticks >> 32, ticks % (1 << 32))
            now_ns = estimator.next_sample_ns(now_ns)
        rates.append(abs(estimator.estimate().freq_hz / FREQ_HZ - RATE))
    assert sorted(rates)[18] < 20e-6


@settings(max_examples=examples(40))
@given(st.lists(st.tuples(st.integers(-5, 1 << 62), st.integers(-5, 1 << 60), st.integers(0, (1 << 32) - 1))))
def test_odd_input_never_raises_and_never_makes_nonsense(rows: list[tuple[int, int, int]]) -> None:
    estimator = ClockEstimator(FREQ_HZ)
    assert estimator.begin(1_000_000_000, 1_000_300_000, 0, 5)
    for sent_ns, trip_ns, clock in rows:
        estimator.add(sent_ns, sent_ns + trip_ns, clock)
        estimate = estimator.estimate()
        assert math.isfinite(estimate.freq_hz)
        assert math.isfinite(estimate.error_s)


@pytest.mark.parametrize("profile", sorted(traces.PROFILES))
def test_within_the_goals_through_a_ramp_and_honest(profile: str) -> None:
    main, secondary = (traces.generate(77, profile, secondary=which) for which in (False, True))
    found = traces.score(main, secondary)
    for got_us, goal_us in zip(found.phases_us, traces.PROFILES[profile].goals_us, strict=True):
        assert got_us <= goal_us
    assert found.dishonest <= 0.003 * found.moments
    assert found.looseness < 7

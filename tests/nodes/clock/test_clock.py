"""The clock estimate: rollovers, bad samples, temperature, and the honesty of its error bound."""

import random
from collections.abc import Callable
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.clock.clock import (
    SETTLE_SAMPLES,
    UPTIME_MAX_S,
    ClockEstimate,
    ClockEstimator,
    HostTime,
    Ticks,
    extend32,
    ticks_since,
)
from nodes.support.errors import CanductorError

FREQ_HZ = 168_000_000
SECOND_NS = 1_000_000_000
WHOLE = 1 << 32


@dataclass
class Clock:
    """A true clock: ticks at host time, with a rate error and a linear drift of the rate."""

    freq_hz: int = FREQ_HZ
    start: int = 0
    ppm: float = 0.0
    ppm_per_s: float = 0.0

    def at(self, at_ns: int) -> int:
        seconds = at_ns * 1e-9
        drift = self.ppm * seconds + self.ppm_per_s * seconds * seconds / 2
        return self.start + at_ns * self.freq_hz // SECOND_NS + round(self.freq_hz * 1e-6 * drift)


Delays = Callable[[], tuple[int, int]]


def fixed(out_ns: int = 150_000, back_ns: int = 150_000) -> Delays:
    return lambda: (out_ns, back_ns)


def exponential(seed: int, base_us: float, mean_us: float, *, outliers: float = 0.01) -> Delays:
    source = random.Random(seed)

    def one() -> int:
        more = source.uniform(1000, 5000) if source.random() < outliers else 0
        return round(1000 * (base_us + source.expovariate(1 / mean_us) + more))

    return lambda: (one(), one())


def run(clock: Clock, delays: Delays, seconds: float, *, start_ns: int = SECOND_NS) -> ClockEstimator:
    """Sample CLOCK as the estimator asks for it."""
    estimator = ClockEstimator(clock.freq_hz)
    now_ns, end_ns = start_ns, start_ns + round(seconds * SECOND_NS)
    first = True
    while now_ns < end_ns:
        out_ns, back_ns = delays()
        read = clock.at(now_ns + out_ns)
        received_ns = now_ns + out_ns + back_ns
        if first:
            assert estimator.begin(now_ns, received_ns, read >> 32, read % WHOLE)
        else:
            assert estimator.add(now_ns, received_ns, read % WHOLE)
        first = False
        now_ns = estimator.next_sample_ns(now_ns)
    return estimator


def error_s(estimator: ClockEstimator, clock: Clock, at_ns: int) -> float:
    return (estimator.ticks_at(HostTime(at_ns)) - clock.at(at_ns)) / clock.freq_hz


# ------------------------------------------------------------------------------------------------------ ticks


@given(st.integers(0, 1 << 63), st.integers(-(1 << 31), (1 << 31) - 1))
def test_a_32_bit_clock_is_extended_to_the_nearest(near: int, away: int) -> None:
    true = near + away
    assert extend32(true % WHOLE, Ticks(near)) == true
    assert ticks_since(true % WHOLE, near % WHOLE) == away


def test_the_rollover_itself() -> None:
    assert ticks_since(5, WHOLE - 5) == 10
    assert ticks_since(WHOLE - 5, 5) == -10
    assert extend32(3, Ticks(7 * WHOLE - 1)) == 7 * WHOLE + 3
    assert extend32(WHOLE - 1, Ticks(7 * WHOLE + 3)) == 7 * WHOLE - 1


@given(st.integers(1 << 40, 1 << 60), st.floats(1e6, 6e8), st.integers(-(10**10), 10**10))
def test_an_estimate_converts_both_ways(at_ticks: int, freq_hz: float, away_ns: int) -> None:
    estimate = ClockEstimate(freq_hz, HostTime(10**15), Ticks(at_ticks), 0.0)
    there = HostTime(10**15 + away_ns)
    assert abs(estimate.ns_at(estimate.ticks_at(there)) - there) <= 1e9 / freq_hz / 2 + 2


# --------------------------------------------------------------------------------------------------- estimate


def test_several_rollovers_with_one_sample_a_second() -> None:
    # 520 MHz rolls over every 8.3 s; it starts 1 s before the first rollover.
    clock = Clock(freq_hz=520_000_000, start=WHOLE - 2 * 520_000_000, ppm=200)
    estimator = run(clock, fixed(), 60)
    now_ns = 61 * SECOND_NS
    assert clock.at(now_ns) > 7 * WHOLE
    assert abs(error_s(estimator, clock, now_ns)) < 2e-6


def test_a_silence_longer_than_a_rollover_is_bridged() -> None:
    clock = Clock(freq_hz=520_000_000, ppm=-120)
    estimator = run(clock, fixed(), 20)
    late_ns = 21 * SECOND_NS + 40 * SECOND_NS
    read = clock.at(late_ns + 150_000)
    assert estimator.add(late_ns, late_ns + 300_000, read % WHOLE)
    assert abs(error_s(estimator, clock, late_ns)) < 5e-6


@pytest.mark.parametrize("ppm", [-500, -200, 0, 200, 500])
def test_good_within_two_seconds(ppm: float) -> None:
    clock = Clock(ppm=ppm, start=123 << 32)
    estimator = run(clock, exponential(7, 150, 100), 2)
    assert estimator.ready
    assert abs(error_s(estimator, clock, 3 * SECOND_NS)) < 50e-6
    assert estimator.estimate().freq_hz == pytest.approx(FREQ_HZ * (1 + ppm * 1e-6), rel=60e-6)


@pytest.mark.parametrize("direction", [0, 1])
def test_a_first_sample_12_ms_late_does_no_lasting_harm(direction: int) -> None:
    clock = Clock(ppm=30)
    ordinary, first = exponential(3, 150, 100, outliers=0), [True]

    def delays() -> tuple[int, int]:
        out_ns, back_ns = ordinary()
        late_ns = 12_000_000 if first.pop() else 0
        first.append(False)
        return (out_ns, back_ns + late_ns) if direction else (out_ns + late_ns, back_ns)

    estimator = run(clock, delays, 2)
    assert abs(error_s(estimator, clock, 3 * SECOND_NS)) < 50e-6


def test_a_bus_that_turns_slow_for_good_is_not_locked_out() -> None:
    clock = Clock(ppm=20, ppm_per_s=0.02)
    quick, slow = exponential(1, 100, 20), exponential(2, 2000, 300)
    asked = [0]

    def delays() -> tuple[int, int]:
        asked[0] += 1
        return quick() if asked[0] < 60 else slow()

    estimator = run(clock, delays, 400)
    assert abs(error_s(estimator, clock, 401 * SECOND_NS)) < 200e-6


@pytest.mark.parametrize("seed", range(6))
def test_the_error_bound_is_honest(seed: int) -> None:
    clock = Clock(ppm=50, ppm_per_s=10 / 600)
    delays = exponential(seed, 150, 100)
    estimator = ClockEstimator(clock.freq_hz)
    now_ns = SECOND_NS
    for i in range(300):
        out_ns, back_ns = delays()
        read, received_ns = clock.at(now_ns + out_ns), now_ns + out_ns + back_ns
        if i:
            estimator.add(now_ns, received_ns, read % WHOLE)
        else:
            estimator.begin(now_ns, received_ns, read >> 32, read % WHOLE)
        estimate = estimator.estimate()
        assert abs(estimate.at_ticks - clock.at(estimate.at_ns)) / clock.freq_hz <= estimate.error_s
        now_ns = estimator.next_sample_ns(now_ns)
    assert estimator.estimate().error_s < 400e-6


def test_an_asymmetric_line_stays_inside_the_bound() -> None:
    clock = Clock(ppm=10)
    estimator = run(clock, fixed(out_ns=50_000, back_ns=950_000), 10)
    error = abs(error_s(estimator, clock, estimator.estimate().at_ns))
    assert error == pytest.approx(450e-6, rel=0.02)
    estimate = estimator.estimate()
    assert error <= estimate.error_s + estimate.asymmetry_s < 600e-6


def test_a_warming_crystal_is_followed() -> None:
    clock = Clock(ppm=50, ppm_per_s=10 / 600)
    estimator = run(clock, exponential(5, 60, 30), 500)
    assert abs(error_s(estimator, clock, 501 * SECOND_NS)) < 25e-6


# ------------------------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("sent_ns", "received_ns"), [(0, SECOND_NS), (2 * SECOND_NS, 2 * SECOND_NS - 1), (1, SECOND_NS // 2)]
)
def test_samples_without_sound_times_are_counted_and_left_out(sent_ns: int, received_ns: int) -> None:
    estimator = run(Clock(), fixed(), 0.5)
    before = estimator.estimate()
    assert not estimator.add(sent_ns, received_ns, 12345)
    assert estimator.unusable == 1
    assert estimator.estimate() == before


def test_the_first_sample_must_have_sound_times_too() -> None:
    estimator = ClockEstimator(FREQ_HZ)
    assert not estimator.begin(0, SECOND_NS, 0, 5)
    with pytest.raises(RuntimeError):
        estimator.estimate()


def test_an_uptime_of_more_than_ten_years_is_refused() -> None:
    estimator = ClockEstimator(FREQ_HZ)
    last = round(UPTIME_MAX_S * FREQ_HZ)
    assert estimator.begin(1, SECOND_NS, last >> 32, last % WHOLE)
    for ticks in (last + 1, 2**63, 2**64 - 1, -1):
        with pytest.raises(CanductorError, match=f"an uptime of {ticks} ticks at {FREQ_HZ} Hz; power-cycle"):
            estimator.begin(1, SECOND_NS, ticks >> 32, ticks % WHOLE)
    assert estimator.estimate().at_ticks == last, "what was known before is still"


def test_first_a_burst_then_ever_slower_to_one_a_second() -> None:
    estimator = run(Clock(), fixed(), 0.3)
    assert not estimator.ready
    assert estimator.next_sample_ns(0) < SECOND_NS // 20
    estimator = run(Clock(), fixed(), 3)
    assert estimator.ready
    assert SETTLE_SAMPLES <= estimator.accepted < SETTLE_SAMPLES + 4
    assert SECOND_NS * 0.9 < estimator.next_sample_ns(0) < SECOND_NS


def test_beginning_anew_forgets_the_clock_before_a_reset() -> None:
    estimator = run(Clock(start=9 << 40), fixed(), 3)
    fresh = Clock(start=17)
    at_ns = 10 * SECOND_NS
    assert estimator.begin(at_ns, at_ns + 300_000, 0, fresh.at(at_ns + 150_000) % WHOLE)
    assert estimator.accepted == 1
    assert abs(estimator.ticks_at(HostTime(at_ns)) - fresh.at(at_ns) % WHOLE) < FREQ_HZ * 1e-6

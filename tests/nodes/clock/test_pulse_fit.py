"""The fit of one clock to another from latched pairs, against the same by least squares of weighted rows."""

import random

import numpy as np
import pytest

from nodes.clock.clock import Ticks
from nodes.clock.pulse_fit import SETTLE_PAIRS, PulseFit, PulseLine
from tests.nodes.bounds import Array

REFERENCE_HZ, FREQ_HZ = 168_000_000, 64_000_000
Pair = tuple[Ticks, Ticks]


def latched(t: float, late_s: float = 0.0, late_reference_s: float = 0.0) -> Pair:
    """Return what is latched at T, in seconds, of a clock that is 80 ppm fast and bends by 0.05 ppm/s."""
    reference_s = t + late_reference_s
    own_s = t + 80e-6 * t + 5e-8 * t * t / 2 + late_s
    return Ticks(10**10 + round(reference_s * REFERENCE_HZ)), Ticks(10**9 + round(own_s * FREQ_HZ))


def pairs_of(count: int, step_s: float = 0.3) -> list[Pair]:
    """Return pairs that are late by some tenths of a microsecond on either side, a few by 30."""
    rng = random.Random(count)
    found = []
    for i in range(count):
        late_s = [rng.uniform(0, 0.8e-6) + (30e-6 if rng.random() < 0.06 else 0) for _ in range(2)]
        found.append(latched(step_s * i, *late_s))
    return found


def noise_s(off_s: Array) -> float:
    return max(0.3e-6, 1.4826 * float(np.median(off_s)))


class ByLeastSquares:
    """Fits with weights that shrink with age and with distance, four times over."""

    def __init__(self) -> None:
        self.pairs: list[Pair] = []
        self.off_s: Array = np.zeros(0)
        self.coefficients: Array = np.zeros(3)
        self.error_s = 0.0

    def add(self, pair: Pair) -> None:
        """Take a pair: how far it lies off the last fit is what it is doubted by."""
        off_s = self._off(pair) if self.pairs else 0.0
        self.off_s = np.append(self.off_s, off_s)[-64:]
        self.pairs = [*self.pairs, pair][-64:]
        self.fit(self.off_s if len(self.pairs) >= 24 else np.zeros(len(self.pairs)))

    def fit(self, off_s: Array) -> None:
        t, y = self._seconds(self.pairs, self.pairs[-1])
        rows = np.stack([t**0, t, t**2 / 2], 1)
        noise = noise_s(off_s)
        for _ in range(4):
            trust = [
                min(1.0, (3 * noise / off) ** 2) if off > 0.3e-6 else min(1.0, 1e14 * noise**2)
                for off in off_s
            ]
            weight = np.exp(t / 8) * trust / noise**2
            # What is believed of the rate and its change counts like two readings more.
            extra = np.array([[0, 1e3, 0], [0, 0, 1e7]])
            weighted = np.concatenate([rows * np.sqrt(weight)[:, None], extra])
            values = np.concatenate([y * np.sqrt(weight), [0, 0]])
            self.coefficients, *_ = np.linalg.lstsq(weighted, values, rcond=None)
            off_s = np.abs(y - rows @ self.coefficients)
            noise = noise_s(off_s)
        self.off_s = off_s
        ahead = np.array([1, 1.5, 1.5**2 / 2])
        spread = np.linalg.pinv(weighted.T @ weighted, rcond=1e-30)
        self.error_s = 3 * float(np.sqrt(ahead @ spread @ ahead)) + noise

    def _off(self, pair: Pair) -> float:
        """Return how far PAIR lies off the last fit, in whole ticks."""
        last = self.pairs[-1]
        t = (pair[0] - last[0]) / REFERENCE_HZ
        a, b, c = self.coefficients
        expected = last[1] + round((t + a + b * t + c * min(t, 6.0) ** 2 / 2) * FREQ_HZ)
        return float(abs(pair[1] - expected) / FREQ_HZ)

    @staticmethod
    def _seconds(pairs: list[Pair], last: Pair) -> tuple[Array, Array]:
        t = np.array([(reference - last[0]) / REFERENCE_HZ for reference, _ in pairs])
        return t, np.array([(ticks - last[1]) / FREQ_HZ for _, ticks in pairs]) - t


def check(line: PulseLine | None, wanted: ByLeastSquares) -> None:
    assert line is not None
    assert (line.reference, line.ticks) == wanted.pairs[-1]
    assert (line.reference_hz, line.freq_hz) == (REFERENCE_HZ, FREQ_HZ)
    found = line.offset_s, line.rate, line.curvature_per_s
    for value, reference, scale in zip(found, wanted.coefficients, (1e-6, 1e-6, 1e-7), strict=True):
        assert value == pytest.approx(reference, rel=1e-6, abs=scale * 1e-5)
    assert line.error_s == pytest.approx(wanted.error_s, rel=1e-6)


def test_pairs_one_by_one_give_the_robust_parabola_of_the_newest() -> None:
    fit, wanted = PulseFit(REFERENCE_HZ, FREQ_HZ), ByLeastSquares()
    for pair in pairs_of(90):
        fit.add(*pair)
        wanted.add(pair)
        check(fit.line, wanted)
    assert fit.restarts == 0


def test_pairs_all_at_once_are_fitted_without_doubts_of_before() -> None:
    fit, wanted = PulseFit(REFERENCE_HZ, FREQ_HZ), ByLeastSquares()
    fit.add(*latched(-7.0))
    pairs = pairs_of(70)
    fit.fill(pairs)
    wanted.pairs = pairs[-64:]
    wanted.fit(np.zeros(64))
    check(fit.line, wanted)
    wanted.add(latched(21.3, 4e-6))
    fit.add(*latched(21.3, 4e-6))
    check(fit.line, wanted)
    fit.fill([])
    assert fit.line is None
    assert not fit.settled


def test_a_fit_is_settled_after_24_pairs_and_a_second() -> None:
    for count, per_s, settled in ((23, 1, False), (24, 1, True), (24, 24, False), (25, 24, True)):
        fit = PulseFit(REFERENCE_HZ, FREQ_HZ)
        fit.fill(
            (Ticks(5 * REFERENCE_HZ + i * REFERENCE_HZ // per_s), Ticks(10**12 + i * FREQ_HZ // per_s))
            for i in range(count)
        )
        assert fit.settled is settled


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize(("passed_s", "allowed_s"), [(0.5, 1.5e-3), (20.0, 21e-3)])
def test_clocks_that_part_by_more_than_crystals_do_have_jumped(
    passed_s: float, allowed_s: float, direction: int
) -> None:
    """A millisecond, and one more in every second."""
    tick = 1 / FREQ_HZ
    for part_s, jumped in ((allowed_s - 2 * tick, False), (allowed_s + 2 * tick, True)):
        first = Ticks(0), Ticks(0)
        second = (
            Ticks(round(passed_s * REFERENCE_HZ)),
            Ticks(round((passed_s + direction * part_s) * FREQ_HZ)),
        )
        one, other = PulseFit(REFERENCE_HZ, FREQ_HZ), PulseFit(REFERENCE_HZ, FREQ_HZ)
        one.add(*first)
        one.add(*second)
        assert one.restarts == jumped
        other.fill([first, second])
        assert one.line is not None
        assert other.line is not None
        for line in (one.line, other.line):
            assert (line.rate == 0.0) is jumped, "a single pair says nothing of the rate"
            assert (line.reference, line.ticks) == second


def test_the_fit_before_a_jump_is_kept_until_there_are_enough_pairs_after_it() -> None:
    fit = PulseFit(REFERENCE_HZ, FREQ_HZ)

    def latch(begin_s: float, count: int, ahead_s: float) -> None:
        for i in range(count):
            reference, ticks = latched(begin_s + 0.3 * i)
            fit.add(reference, Ticks(ticks + round(ahead_s * FREQ_HZ)))

    latch(0.0, SETTLE_PAIRS, 0.0)
    before = fit.line
    assert fit.line_before is None
    latch(10.0, 1, 0.5)
    assert fit.line_before is before is not fit.line
    latch(11.0, 1, 0.0)  # it jumps back, and what follows the second jump is no better than what preceded
    assert fit.line_before is before
    latch(12.0, SETTLE_PAIRS - 2, 0.0)
    assert fit.line_before is before
    latch(20.0, 1, 0.0)
    assert (fit.settled, fit.line_before) == (True, None)


def test_a_reference_that_stands_still_or_goes_back_has_jumped() -> None:
    for step in (0, -5):
        one, other = PulseFit(REFERENCE_HZ, FREQ_HZ), PulseFit(REFERENCE_HZ, FREQ_HZ)
        pairs = [latched(0.3 * i) for i in range(30)]
        pairs.append((Ticks(pairs[-1][0] + step), pairs[-1][1]))
        for pair in pairs:
            one.add(*pair)
        assert (one.restarts, one.settled) == (1, False)
        other.fill(pairs)
        assert not other.settled


# ------------------------------------------------------------------------------------------------------- line


def line_of(rate: float = 2e-4, curvature_per_s: float = 4e-7) -> PulseLine:
    return PulseLine(
        Ticks(10**10), Ticks(10**9), 10_000_000, 1_000_000_000, 3e-6, rate, curvature_per_s, 1e-6
    )


def test_a_line_bends_for_six_seconds_and_then_goes_straight_on() -> None:
    for t, parted_s in (
        (0.0, 3e-6),
        (1.0, 3e-6 + 2e-4 + 2e-7),
        (6.0, 3e-6 + 12e-4 + 72e-7),
        (7.0, 3e-6 + 14e-4 + 72e-7),
        (-2.0, 3e-6 - 4e-4 + 8e-7),
        (-20.0, 3e-6 - 40e-4 + 800e-7),
    ):
        reference = Ticks(10**10 + round(t * 10_000_000))
        assert line_of().ticks_at(reference) == 10**9 + round((t + parted_s) * 1e9)


@pytest.mark.parametrize("rate", [1e-3, -1e-3])
def test_the_way_back_is_exact_to_a_tick(rate: float) -> None:
    line = line_of(rate)
    for t in (-30.0, -1.0, 0.0, 2.5, 6.0, 40.0):
        reference = Ticks(10**10 + round(t * 10_000_000))
        assert line.reference_at(line.ticks_at(reference)) == reference

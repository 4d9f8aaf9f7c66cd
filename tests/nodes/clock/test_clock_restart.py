"""When the estimate of a node's clock begins again, and when it does not."""

import random
from dataclasses import dataclass, field

import pytest

from nodes.clock.clock import CONTRADICTIONS, GAP_NS, LATELY_NS, ClockEstimator, HostTime
from nodes.clock.start import START_SAMPLES

FREQ_HZ = 168_000_000
SECOND_NS = 1_000_000_000
WHOLE = 1 << 32
TOLERANCE_S = 60e-6
"""Ways of 150 µs and some 50 µs of chance on top; an estimate with a filter is better than this."""


@dataclass
class Node:
    """A node whose clock runs 50 ppm fast, and the estimator that follows it, in host time."""

    now_ns: int = SECOND_NS
    zero_ns: int = 0
    """When its clock was 0."""
    estimator: ClockEstimator = field(default_factory=lambda: ClockEstimator(FREQ_HZ))
    _random: random.Random = field(default_factory=lambda: random.Random(5))

    def ticks(self, at_ns: int) -> int:
        """Return its clock in 64 bits."""
        return round((at_ns - self.zero_ns) * 1e-9 * FREQ_HZ * (1 + 50e-6))

    def sample(
        self, *, wrong_s: float = 0.0, late_s: float = 0.0, begin: bool = False, used: bool = True
    ) -> None:
        """Ask once, as often as the estimator asks for it; the answer is wrong by WRONG_S, USED or not.

        It is LATE_S behind its time.
        """
        out_ns, back_ns = (150_000 + round(self._random.expovariate(1 / 50_000)) for _ in range(2))
        back_ns += round(late_s * SECOND_NS)
        clock = self.ticks(self.now_ns + out_ns) + round(wrong_s * FREQ_HZ)
        received_ns = self.now_ns + out_ns + back_ns
        if begin:
            assert self.estimator.begin(self.now_ns, received_ns, clock >> 32, clock % WHOLE)
        else:
            assert self.estimator.add(self.now_ns, received_ns, clock % WHOLE) is used
        self.now_ns = self.estimator.next_sample_ns(self.now_ns)

    def follow(self, samples: int) -> None:
        """Begin, and take SAMPLES in all."""
        self.sample(begin=True)
        for _ in range(samples - 1):
            self.sample()

    @property
    def error_s(self) -> float:
        """The error of the estimate now."""
        return (self.estimator.ticks_at(HostTime(self.now_ns)) - self.ticks(self.now_ns)) / FREQ_HZ


@pytest.fixture
def settled() -> Node:
    """Return a node that has been followed for so long that the filter has taken over."""
    node = Node()
    node.follow(START_SAMPLES + 20)
    assert abs(node.error_s) < TOLERANCE_S
    return node


def test_a_node_that_restarts_is_measured_without_the_filter_of_its_life_before(settled: Node) -> None:
    settled.now_ns += 3 * SECOND_NS
    settled.zero_ns = settled.now_ns - SECOND_NS // 2
    settled.sample(begin=True)
    assert abs(settled.error_s) < TOLERANCE_S
    assert settled.estimator.estimate().error_s > 10 * TOLERANCE_S, "one answer says nothing about the rate"
    for _ in range(START_SAMPLES + 4):
        settled.sample()
        assert abs(settled.error_s) < 2 * TOLERANCE_S
        assert abs(settled.error_s) < settled.estimator.estimate().error_s


@pytest.mark.parametrize("jump_s", [0.3, -0.3])
def test_a_clock_that_has_jumped_is_measured_from_where_it_is_now(settled: Node, jump_s: float) -> None:
    settled.zero_ns -= round(jump_s * 1e9)
    for _ in range(CONTRADICTIONS - 1):
        settled.sample(used=False)
    assert abs(settled.error_s) > abs(jump_s) / 2, "a few answers do not yet overrule all before"
    settled.sample()
    assert abs(settled.error_s) < 2 * TOLERANCE_S
    for _ in range(10):
        settled.sample()
        assert abs(settled.error_s) < settled.estimator.estimate().error_s


@pytest.mark.parametrize(("moved_s", "jumps"), [(2e-3, 1), (-2e-3, 1), (0.6e-3, 0)])
def test_a_jump_is_told_from_a_clock_that_begins_again_close_by(
    settled: Node, moved_s: float, jumps: int
) -> None:
    settled.zero_ns -= round(moved_s * 1e9)
    for _ in range(CONTRADICTIONS - 1):
        settled.sample(used=False)
    found_ns = settled.now_ns
    settled.sample()
    assert settled.estimator.jumps == jumps
    jump_s = settled.estimator.jump_s
    assert jump_s == pytest.approx(moved_s * jumps, abs=TOLERANCE_S)
    assert settled.estimator.jumped_lately_s(found_ns + LATELY_NS) == jump_s
    assert settled.estimator.jumped_lately_s(found_ns + LATELY_NS + SECOND_NS) == 0


def test_an_estimate_that_was_off_within_the_time_of_its_answers_is_no_jump() -> None:
    """As on a bus that others fill: all answers come 6 ms late, until the bus is free again."""
    node = Node()
    node.sample(late_s=6e-3, begin=True)
    for _ in range(START_SAMPLES + 20):
        node.sample(late_s=6e-3)
    assert node.error_s < -2e-3
    for _ in range(CONTRADICTIONS - 1):
        node.sample(used=False)
    node.sample()
    assert abs(node.error_s) < 2 * TOLERANCE_S
    assert node.estimator.jumps == 0


@pytest.mark.parametrize("zero_s", [0.0, 3.0, 25.5])
def test_what_was_read_before_now_cannot_be_ahead_of_now(settled: Node, zero_s: float) -> None:
    """Wherever its 32 bits stand: they roll over each 25.6 s."""
    moved_ns = round(zero_s * 1e9)
    moved = Node(now_ns=settled.now_ns + moved_ns)
    moved.follow(START_SAMPLES + 20)
    now_ns = moved.now_ns + SECOND_NS // 2
    clock = moved.ticks(now_ns)
    for late_s in (-5.0, -1e-3, 0.0, 20e-6):
        assert moved.estimator.ahead_s(now_ns, (clock + round(late_s * FREQ_HZ)) % WHOLE) == 0.0
    for ahead_s in (1e-3, 0.5, 12.0):
        found_s = moved.estimator.ahead_s(now_ns, (clock + round(ahead_s * FREQ_HZ)) % WHOLE)
        assert found_s == pytest.approx(ahead_s, abs=TOLERANCE_S)


def test_behind_a_long_silence_the_rate_is_learned_again(settled: Node) -> None:
    known_s = settled.estimator.estimate().error_s
    settled.now_ns += GAP_NS + 2 * SECOND_NS
    settled.sample()
    assert settled.estimator.estimate().error_s > 10 * known_s
    assert abs(settled.error_s) < 2 * TOLERANCE_S


@pytest.mark.parametrize("wrong_s", [0.02, -0.02])
def test_wrong_answers_far_apart_do_not_overrule_the_right_ones_between(
    settled: Node, wrong_s: float
) -> None:
    for _ in range(4 * CONTRADICTIONS):
        settled.sample(wrong_s=wrong_s, used=False)
        assert abs(settled.error_s) < settled.estimator.estimate().error_s
        for _ in range(12):
            settled.sample()
            assert abs(settled.error_s) < settled.estimator.estimate().error_s

"""The exact optimum of step compression: the least commands, or bytes, that keep every step in its band.

Dynamic programming over all states "the first i steps are done, the last of them at clock c". From a state
every legal segment (interval, add, count) is tried, for all clocks of a run of states at once: a pair
(interval, add) moves every clock of the run by the same number of ticks, so that what stays inside the bands
is an interval of clocks, and only its ends have to be followed. No pair is left out, nothing is rounded.

Practical for some 60 steps with bands of up to about 200 ticks.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nodes.dictionary.message_format import vlq

Ints = np.ndarray[tuple[int], np.dtype[np.int64]]
Bools = np.ndarray[tuple[int], np.dtype[np.bool_]]
Price = Callable[[Ints, Ints, int], Ints]
"""(intervals, adds, count) -> the cost of each segment; small whole numbers > 0."""

UNREACHED = 1 << 30
ADD_MIN, ADD_MAX = -32768, 32767
COUNT_MAX = 65535


@dataclass(frozen=True)
class Problem:
    """Steps of one stepper by the whole clocks each may have."""

    bands: Sequence[tuple[int, int]]
    start: int
    """Clock from which the first segment counts."""
    pulse: int = 1
    """No interval is shorter."""
    turns: frozenset[int] = frozenset()
    """Steps before which the stepper turns round, so that a new segment begins."""


def commands(intervals: Ints, adds: Ints, count: int) -> Ints:
    """Price every segment as one command."""
    return np.ones(len(intervals), np.int64)


def payload_bytes(prefix: int) -> Price:
    """Price a segment by its bytes: PREFIX of them for id and oid, then the three values."""

    def price(intervals: Ints, adds: Ints, count: int) -> Ints:
        total: Ints = prefix + len(vlq(count)) + vlq_sizes(intervals) + vlq_sizes(adds)
        return total

    return price


def vlq_sizes(values: Ints) -> Ints:
    """Return how many bytes each value takes on the wire (1..5)."""
    size = np.ones(len(values), np.int64)
    for bits in (5, 12, 19, 26):
        size += (values < -(1 << bits)) | (values >= 3 << bits)
    return size


def optimum(problem: Problem, price: Price = commands) -> int:
    """Return the least total price of segments that make every step of PROBLEM inside its band."""
    bands = problem.bands
    best = [np.full(high - low + 1, UNREACHED, np.int64) for low, high in bands]
    before = np.zeros(1, np.int64)
    for i in range(len(bands)):
        low = bands[i - 1][0] if i else problem.start
        for cost in np.unique(before[before < UNREACHED]):
            _spread(problem, price, best, i, (int(cost), *_runs(before <= cost, low)))
        before = best[i]
    total = int(before.min())
    assert total < UNREACHED, "no segments make these steps"
    return total


def _runs(mask: Bools, low: int) -> tuple[Ints, Ints]:
    """Return the first and last clock of every run of states in MASK, whose first state is clock LOW."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False]))))
    return low + edges[::2], low + edges[1::2] - 1


def _expand(low: Ints, high: Ints) -> tuple[Ints, Ints]:
    """Return (which, value) for every whole value in each [low, high]."""
    count = np.maximum(high - low + 1, 0)
    which = np.repeat(np.arange(len(low)), count)
    first = np.cumsum(count) - count
    return which, low[which] + np.arange(len(which)) - first[which]


def _spread(problem: Problem, price: Price, best: list[Ints], i: int, states: tuple[int, Ints, Ints]) -> None:
    """Follow every segment to step I and on from STATES: (what they cost, first, last clock of each run)."""
    cost, begin, until = states
    bands, pulse = problem.bands, problem.pulse
    low, high = bands[i]
    end = min([turn for turn in problem.turns if turn > i] + [len(bands), i + COUNT_MAX])
    # One step: every interval.
    which, interval = _expand(np.maximum(low - until, pulse), high - begin)
    first = np.maximum(begin[which], low - interval)
    last = np.minimum(until[which], high - interval)
    _mark(best[i], low, cost + price(interval, np.zeros_like(interval), 1), first + interval, last + interval)
    if i + 1 >= end:
        return
    # Two steps: every add that any of these clocks can have.
    low, high = bands[i + 1]
    least = np.maximum(np.maximum(low - last - 2 * interval, pulse - interval), ADD_MIN)
    which, add = _expand(least, np.minimum(high - first - 2 * interval, ADD_MAX))
    interval, first, last = interval[which], first[which], last[which]
    for k in range(2, end - i + 1):
        low, high = bands[i + k - 1]
        way = k * interval + add * (k * (k - 1) // 2)
        first, last = np.maximum(first, low - way), np.minimum(last, high - way)
        alive = (first <= last) & (interval + add * (k - 1) >= pulse)
        interval, add, first, last, way = (x[alive] for x in (interval, add, first, last, way))
        if not len(add):
            return
        _mark(best[i + k - 1], low, cost + price(interval, add, k), first + way, last + way)


def _mark(best: Ints, low: int, costs: Ints, first: Ints, last: Ints) -> None:
    """Lower BEST, whose first state is clock LOW, to COSTS over the clocks from FIRST to LAST."""
    legal = first <= last
    for cost in np.unique(costs[legal]):
        mine = legal & (costs == cost)
        edges = np.bincount(first[mine] - low, minlength=len(best) + 1)
        edges = edges - np.bincount(last[mine] - low + 1, minlength=len(best) + 1)
        reached = np.cumsum(edges)[:-1] > 0
        best[reached & (best > cost)] = cost

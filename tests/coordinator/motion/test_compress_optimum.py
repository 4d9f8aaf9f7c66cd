"""Step compression against the exact optimum on small inputs, and the optimum against trying everything."""

import itertools
import json
import random
from functools import cache

import pytest

from nodes.dictionary.message_format import vlq
from tests.coordinator.motion.compress_cases import KINDS, OPTIMA, PREFIX, Case, Yield, cases, compress
from tests.coordinator.motion.compress_oracle import Price, Problem, commands, optimum, payload_bytes
from tests.profiles import is_full

COMMANDS_EXCESS, BYTES_EXCESS = 1.05, 1.05
"""Most that the engine's total over the whole set may be, as a share of the optimum's. The search spares
commands first and bytes second; each optimum is that of its own price."""
CHECKED = 20 if is_full() else 2
"""Cases of each kind solved again: those with the slowest clock, whose bands are narrowest."""


@cache
def _set() -> dict[str, tuple[Case, Yield]]:
    return {case.name: (case, compress(case)) for case in cases()}


def _optima() -> dict[str, tuple[int, int, int]]:
    return {name: tuple(row) for name, row in json.loads(OPTIMA.read_text()).items()}


def test_the_optima_are_of_this_set_and_not_beaten() -> None:
    optima, made = _optima(), {name: found for name, (_, found) in _set().items()}
    assert optima.keys() == made.keys()
    assert len(made) >= 200
    for name, (start, fewest, smallest) in optima.items():
        assert made[name].start == start, (
            f"{name}: write {OPTIMA.name} anew, its start clocks are no longer ours"
        )
        assert made[name].commands >= fewest, f"{name}: better than the optimum cannot be"
        assert made[name].payload >= smallest, name


def test_few_more_commands_than_the_optimum() -> None:
    made = sum(found.commands for _, found in _set().values())
    assert made <= COMMANDS_EXCESS * sum(fewest for _, fewest, _ in _optima().values())


def test_few_more_bytes_than_the_optimum() -> None:
    made = sum(found.payload for _, found in _set().values())
    assert made <= BYTES_EXCESS * sum(smallest for _, _, smallest in _optima().values())


def test_the_stored_optima_are_those_of_the_oracle() -> None:
    optima = _optima()
    slowest = sorted((case for case, _ in _set().values()), key=lambda case: case.freq)
    for kind in KINDS:
        for case in [case for case in slowest if case.kind == kind][:CHECKED]:
            start, fewest, smallest = optima[case.name]
            problem = case.problem(start)
            assert (fewest, smallest) == (optimum(problem), optimum(problem, payload_bytes(PREFIX))), (
                case.name
            )


# ------------------------------------------------------------------------------ the oracle's own oracle


def _by_trying(problem: Problem, sizes: bool) -> int:
    """Return the optimum by following every segment from every state."""
    best: list[dict[int, int]] = [{problem.start: 0}, *({} for _ in problem.bands)]
    for i, at in itertools.chain.from_iterable(
        ((i, clock) for clock in range(low, high + 1))
        for i, (low, high) in enumerate([(problem.start, problem.start), *problem.bands[:-1]])
    ):
        if at not in best[i]:
            continue
        end = min([turn for turn in problem.turns if turn > i] + [len(problem.bands)])
        for first in range(problem.bands[i][0], problem.bands[i][1] + 1):
            seconds = range(problem.bands[i + 1][0], problem.bands[i + 1][1] + 1) if i + 1 < end else ()
            for add in {0} | {second - 2 * first + at for second in seconds}:
                interval, clock = first - at, at
                for j in range(i, end):
                    every = interval + add * (j - i)
                    clock += every
                    low, high = problem.bands[j]
                    if every < problem.pulse or not low <= clock <= high or not -32768 <= add <= 32767:
                        break
                    values = (interval, j - i + 1, add)
                    price = 2 + sum(len(vlq(v)) for v in values) if sizes else 1
                    found = best[i][at] + price
                    best[j + 1][clock] = min(best[j + 1].get(clock, found), found)
    return min(best[-1].values())


@pytest.mark.parametrize("sizes", [False, True])
@pytest.mark.parametrize("seed", range(12))
def test_the_oracle_finds_what_trying_everything_finds(seed: int, sizes: bool) -> None:
    rng = random.Random(seed)
    t, interval, times = 1000.0, rng.choice([9.3, 14.0, 47.6]), []
    for _ in range(rng.randint(1, 11)):
        times.append(t)
        interval = max(6.0, interval + rng.uniform(-4, 4))
        t += interval
    bands = [(round(t) - rng.randint(0, 3), round(t) + rng.randint(0, 3)) for t in times]
    turns = frozenset(rng.sample(range(len(bands)), min(len(bands), 1))) - {0}
    problem = Problem(bands, rng.choice([993, 300, -40_000]), 4, turns)
    price: Price = payload_bytes(2) if sizes else commands
    assert optimum(problem, price) == _by_trying(problem, sizes)


def test_the_optimum_of_plain_inputs() -> None:
    cruise = [(10 * i - 1, 10 * i + 1) for i in range(1, 60)]
    assert optimum(Problem(cruise, 0)) == 1
    assert optimum(Problem(cruise, 0), payload_bytes(2)) == 5
    assert optimum(Problem(cruise, -50)) == 2, "the first interval is another one"
    assert optimum(Problem(cruise, 0, turns=frozenset({1, 30}))) == 3
    curve = [(1000 + 100 * i + 3 * i * (i - 1) // 2,) * 2 for i in range(1, 60)]
    assert optimum(Problem(curve, 1000)) == 1

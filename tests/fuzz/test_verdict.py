"""What live.py finds wrong; it itself runs in ``make thorough``."""

from collections import Counter
from collections.abc import Callable

import pytest

from tests.fuzz.live import GROWTH_KIB_MAX, Findings, Printed


def sound() -> Findings:
    prints = [Printed(n < 5, 1.0, {"x": 10, "y": -3}, 70_000 + 100 * n) for n in range(6)]
    return Findings(prints, Counter(visits=30), [], {"ok": True})


def grow(printed: Printed) -> None:
    printed.memory_kib += 2 * GROWTH_KIB_MAX


def test_nothing_is_wrong() -> None:
    assert sound().verdict() == []


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda found: found.problems.append("seed 1: it was reset"), "seed 1: it was reset"),
        (lambda found: found.proof.update(ok=False), "proof"),
        (lambda found: found.proof.clear(), "proof"),
        (lambda found: found.prints[2].steps.update(y=-2), "different numbers of steps"),
        (lambda found: found.prints.pop(), "quiet one behind it"),
        (lambda found: found.counts.clear(), "no fuzzer came in"),
        (lambda found: grow(found.prints[5]), "memory grew"),
    ],
)
def test_each_thing_that_is_wrong_is_said(spoil: Callable[[Findings], object], words: str) -> None:
    found = sound()
    spoil(found)
    (sentence,) = found.verdict()
    assert words in sentence

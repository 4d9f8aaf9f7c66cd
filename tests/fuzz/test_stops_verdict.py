"""What live_stops.py finds wrong, and its table; it itself runs in ``make thorough``."""

from collections import Counter
from collections.abc import Callable

import pytest

from tests.fuzz.live_stops import WAYS, Found, Stop, table, verdict


def sound() -> Found:
    stops = [Stop(way, held, 1_000) for way in WAYS for held in (False, True)]
    return Found(stops, [], Counter({"visits": 3, "bursts of noise": 2}))


def test_nothing_is_wrong() -> None:
    assert verdict(sound()) == []


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda found: found.problems.append("the cause is 'lost node'"), "lost node"),
        (lambda found: found.stops.pop(), "terminal, M112 with the loop held"),
        (lambda found: found.counts.pop("visits"), "no fuzzer came in"),
        (lambda found: found.counts.pop("bursts of noise"), "no fuzzer came in"),
    ],
)
def test_each_thing_that_is_wrong_is_said(spoil: Callable[[Found], object], words: str) -> None:
    found = sound()
    spoil(found)
    (sentence,) = verdict(found)
    assert words in sentence


def test_the_table_tells_the_worst_and_how_many_are_above_the_bound() -> None:
    stops = [Stop("TCP, new", held, 0) for held in (False, False, True)]
    rows = list(table(stops, [3.0, 12.0, 20.0]))
    assert rows[1] == "loop free: n 2, worst 12.00 ms, 1 above 10 ms"
    assert rows[3] == "loop held: n 1, worst 20.00 ms, 0 above 50 ms"

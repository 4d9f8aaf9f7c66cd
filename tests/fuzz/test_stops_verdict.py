"""What live_stops.py finds wrong, and its table; it itself runs in ``make thorough``."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.fuzz.live_stops import BOUNDS_MS, WAYS, Found, Stop, late, table, verdict
from tests.fuzz.proved_service import SERVICE_PRIORITY
from tests.fuzz.standstill import stood_still_ms

UNIT = Path(__file__).parents[2] / "docs" / "examples" / "systemd" / "canductor.service"


def sound() -> Found:
    stops = [Stop(way, state, 1_000) for way in WAYS for state in BOUNDS_MS]
    return Found(stops, [], Counter({"visits": 3, "noise: page": 2}))


def test_nothing_is_wrong() -> None:
    found = sound()
    assert verdict(found, [BOUNDS_MS[stop.loop] for stop in found.stops]) == []


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda found: found.problems.append("the cause is 'lost node'"), "lost node"),
        (lambda found: found.stops.pop(), "serial host, M112, the loop calculating"),
        (lambda found: found.counts.pop("visits"), "no fuzzer came in"),
        (lambda found: found.counts.pop("noise: page"), "no fuzzer came in"),
    ],
)
def test_each_thing_that_is_wrong_is_reported(spoil: Callable[[Found], object], words: str) -> None:
    found = sound()
    spoil(found)
    (sentence,) = verdict(found, [1.0] * len(found.stops))
    assert words in sentence


@pytest.mark.parametrize("state", BOUNDS_MS)
def test_a_late_stop_is_wrong(state: str) -> None:
    found = sound()
    taken_ms = [1.0] * len(found.stops)
    late = next(number for number, stop in enumerate(found.stops) if stop.loop == state)
    taken_ms[late] = BOUNDS_MS[state] + 0.01
    (sentence,) = verdict(found, taken_ms)
    assert f"the loop {state}, took {taken_ms[late]:.2f} ms" in sentence


@pytest.mark.parametrize(("stood_ns", "is_excused"), [(2_000_000, True), (1_900_000, False)])
def test_a_stop_that_is_late_as_the_computer_stood_still_is_shown_but_not_judged(
    stood_ns: int, is_excused: bool
) -> None:
    found = Found([Stop("TCP, new", "free", 1_000_000)], stood_still=[(4_000_000, 4_000_000 + stood_ns)])
    ((sentence, excused),) = late(found, [12.0])
    assert "took 12.00 ms" in sentence
    assert excused == is_excused
    assert (sentence in verdict(found, [12.0])) != is_excused


def test_time_in_which_two_processors_stood_still_counts_once() -> None:
    spans = [(1_000_000, 3_000_000), (2_000_000, 4_000_000), (2_500_000, 2_600_000), (9_000_000, 11_000_000)]
    assert stood_still_ms(spans, 0, 10_000_000) == pytest.approx(4.0)
    assert stood_still_ms(spans, 3_500_000, 9_500_000) == pytest.approx(1.0)
    assert stood_still_ms(spans, 5_000_000, 8_000_000) == 0


def test_the_table_has_the_worst_of_each_state() -> None:
    stops = [Stop("TCP, new", state, 0) for state in ("free", "free", "held")]
    rows = list(table(stops, [3.0, 12.0, 20.0]))
    assert rows[1] == "loop free: n 2, worst 12.00 ms; bound 10 ms"
    assert rows[3] == "loop held: n 1, worst 20.00 ms; bound 50 ms"


def test_a_machine_is_stopped_with_the_priority_of_a_service() -> None:
    lines = UNIT.read_text(encoding="utf-8").splitlines()
    assert {"CPUSchedulingPolicy=rr", f"CPUSchedulingPriority={SERVICE_PRIORITY}"} <= set(lines)

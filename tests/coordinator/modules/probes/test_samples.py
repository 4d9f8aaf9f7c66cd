"""How samples become a height, compared with numpy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.modules.probes.probe_commands import Accuracy
from coordinator.modules.probes.samples import SampleRules, SampleSeries, combined

HEIGHTS = st.lists(st.floats(-5, 5), min_size=1, max_size=9)


@given(HEIGHTS)
def test_results_are_those_of_numpy(heights: list[float]) -> None:
    assert combined(heights, "average") == pytest.approx(np.mean(heights), abs=1e-12)
    assert combined(heights, "median") == pytest.approx(np.median(heights), abs=1e-12)
    words = str(Accuracy(tuple(heights))).split()
    told = [float(words[index].rstrip(",")) for index in (4, 6, 8, 10, 12, 15)]
    exact = [
        max(heights),
        min(heights),
        np.ptp(heights),
        np.mean(heights),
        np.median(heights),
        np.std(heights),
    ]
    assert told == pytest.approx(exact, abs=1e-6)


def take_all(rules: SampleRules, *heights: float) -> tuple[SampleSeries, list[str]]:
    series = SampleSeries(rules)
    remarks = []
    for height in heights:
        assert not series.is_complete
        remarks.append(series.take(height))
    return series, remarks


def test_samples_are_taken_until_there_are_enough() -> None:
    series, remarks = take_all(SampleRules(samples=3, result="median"), 1.0, 1.02, 1.01)
    assert series.is_complete
    assert (series.result, series.failed, remarks) == (1.01, "", ["", "", ""])


def test_the_first_result_of_a_place_may_be_dropped() -> None:
    series, remarks = take_all(SampleRules(samples=2, drop_first=True), 9.0, 1.0, 1.05)
    assert series.result == pytest.approx(1.025)
    assert remarks[0] == "the first result is dropped"


def test_samples_that_are_too_far_apart_are_taken_again_as_often_as_allowed() -> None:
    rules = SampleRules(samples=2, tolerance_mm=0.01, retries=1)
    series, remarks = take_all(rules, 1.0, 1.02, 1.0, 1.005)
    assert series.result == pytest.approx(1.0025)
    assert not series.failed
    assert remarks[1] == (
        "the samples are 0.0200 mm apart, more than samples_tolerance (0.01 mm): retry 1 of 1"
    )
    series, _ = take_all(rules, 1.0, 1.02, 1.0, 1.02)
    assert series.is_complete
    assert series.failed.startswith(
        "the samples are 0.0200 mm apart, more than samples_tolerance (0.01 mm), after 1"
    )

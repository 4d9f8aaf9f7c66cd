"""What a table of an axis may be, and what it says between its points."""

import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.tables.axis_table import (
    SLOPE_MAX,
    AxisTable,
    Direction,
    TableError,
    Unit,
    figures,
    notes,
)
from coordinator.tables.plot import draw

TABLE = AxisTable(
    axis="x", positions=(0.0, 10.0, 20.0), forward=(0.0, 0.01, -0.02), reverse=(0.1, 0.11, 0.08)
)


def table(**changes: Any) -> AxisTable:
    return replace(TABLE, **changes)


def test_between_points_it_is_linear_and_beyond_the_ends_it_holds() -> None:
    expected = {-5: 0.0, 0: 0.0, 5: 0.005, 10: 0.01, 15: -0.005, 20: -0.02, 99: -0.02}
    for position, value in expected.items():
        assert TABLE.correction(position, Direction.FORWARD) == pytest.approx(value)
    assert TABLE.correction(5, Direction.REVERSE) == pytest.approx(0.105)


@given(st.floats(-5, 25))
def test_it_is_continuous_and_as_numpy_has_it(position: float) -> None:
    numpy = pytest.importorskip("numpy")
    expected = numpy.interp(position, TABLE.positions, TABLE.reverse)
    assert TABLE.correction(position, Direction.REVERSE) == pytest.approx(float(expected), abs=1e-12)


def test_as_mt_has_it() -> None:
    assert TABLE.pairs(Direction.FORWARD) == [(0, 0), (100_000, 10_000), (200_000, -20_000)]
    assert TABLE.pairs(Direction.REVERSE)[0] == (0, 100_000)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"positions": (0.0, 10.0)}, "has 2 positions, 3 forward and 3 reverse"),
        ({"positions": (0.0,), "forward": (0.0,), "reverse": (0.0,)}, "give 2 to 10000"),
        ({"positions": (0.0, math.nan, 20.0)}, "point 2: a value is not finite"),
        ({"forward": (0.0, math.inf, 0.0)}, "point 2: a value is not finite"),
        ({"positions": (0.0, 10.0, 30_000.0)}, r"point 3: the position 30000 mm is beyond 26843\.5 mm"),
        ({"forward": (0.0, 0.0, 9.0)}, r"point 3: a correction of 9 mm is beyond 5 mm.*type 0"),
        (
            {"positions": (0.0, 20.0, 10.0)},
            "point 3: the position 10 mm follows 20 mm; positions must ascend",
        ),
        ({"positions": (0.0, 10.0, 10.00001)}, r"must ascend by at least 0\.0001 mm"),
        ({"forward": (0.0, 0.3, 0.3)}, rf"point 2: the forward correction .* more than {SLOPE_MAX:g}"),
        ({"reverse": (0.0, 0.0, -0.3)}, "point 3: the reverse correction changes by -0.03 mm per mm"),
    ],
)
def test_what_cannot_be_is_refused(changes: dict[str, Any], problem: str) -> None:
    with pytest.raises(TableError, match=problem):
        table(**changes)


def test_a_table_for_another_travel() -> None:
    assert notes(TABLE, 0, 20) == []
    assert notes(TABLE, None, None) == []
    (note,) = notes(TABLE, -10, 20)
    assert "beyond it the corrections at its ends hold" in note
    with pytest.raises(TableError, match="covers 0 to 20 mm, but the axis travels from 30 to 300 mm"):
        notes(TABLE, 30, 300)


def test_figures() -> None:
    found = figures(TABLE)
    assert (found["points"], found["least_correction"], found["greatest_correction"]) == (3, -0.02, 0.11)
    assert found["greatest_slope"] == pytest.approx(0.003)
    assert found["greatest_backlash"] == pytest.approx(0.1)


@pytest.mark.parametrize(("every_mm", "missed_um"), [(1.0, 0.92), (0.5, 0.23)])
def test_what_a_table_of_a_wobble_misses_between_its_points(every_mm: float, missed_um: float) -> None:
    """Against the wobble itself, 12 µm once in 8 mm, looked at everywhere."""
    at = tuple(every_mm * k for k in range(round(16 / every_mm) + 1))
    wobble = tuple(0.012 * math.sin(math.pi * x / 4) for x in at)
    found = AxisTable(axis="x", positions=at, forward=wobble, reverse=(0.0,) * len(at))
    told_um = 1e3 * float(figures(found)["between_points"])
    assert told_um == pytest.approx(missed_um, rel=0.1)
    fine = [k / 100 for k in range(1601)]
    worst = max(abs(found.correction(x, Direction.FORWARD) - 0.012 * math.sin(math.pi * x / 4)) for x in fine)
    assert told_um == pytest.approx(1e3 * worst, rel=0.1)
    straight = AxisTable(axis="x", positions=(0.0, 1.0), forward=(0.0, 0.01), reverse=(0.0, 0.0))
    assert figures(straight)["between_points"] == 0


@pytest.mark.parametrize("flat", [0.0, 0.5])
def test_a_picture(flat: float) -> None:
    picture = draw(table(axis="<x>", unit=Unit.DEG))
    assert picture.startswith("<svg")
    assert picture.count("<polyline") == 2
    assert "axis &lt;x&gt;" in picture
    assert "nan" not in draw(table(forward=(flat,) * 3, reverse=(flat,) * 3))

"""Deltas found by their heights and lengths, against planted errors."""

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.kinematics.delta import Delta, Tower
from coordinator.modules.levelling.delta_fit import Distance, Height, fit_delta, nozzle_at, ways_at
from tests.profiles import examples

CONFIGURED = Delta(tuple(Tower(math.radians(angle), 250.0, 300.0) for angle in (210, 330, 90)), 110.0)  # type: ignore[arg-type]
AROUND = [
    (80 * math.cos(math.radians(30 + 60 * i)), 80 * math.sin(math.radians(30 + 60 * i))) for i in range(6)
]
PLACES = [(0.0, 0.0), *AROUND]
OFF = st.floats(-2, 2)


def off(radius: float, angles_mm: list[float], ends: list[float], rods: list[float]) -> Delta:
    """Return the configured delta with errors in mm."""
    towers = [
        replace(
            tower,
            angle=tower.angle + angle / CONFIGURED.radius,
            endstop_height=tower.endstop_height + end,
            rod_length=tower.rod_length + rod,
        )
        for tower, angle, end, rod in zip(CONFIGURED.towers, [*angles_mm, 0.0], ends, rods, strict=True)
    ]
    return replace(CONFIGURED, radius=CONFIGURED.radius + radius, towers=(towers[0], towers[1], towers[2]))


def heights_of(true: Delta) -> list[Height]:
    return [Height(0.0, ways_at(true, (x, y, 0.0))) for x, y in PLACES]


def same(found: Delta, true: Delta, within_mm: float) -> None:
    assert found.radius == pytest.approx(true.radius, abs=within_mm)
    for one, other in zip(found.towers, true.towers, strict=True):
        assert one.angle * true.radius == pytest.approx(other.angle * true.radius, abs=within_mm)
        assert one.endstop_height == pytest.approx(other.endstop_height, abs=within_mm)
        assert one.rod_length == pytest.approx(other.rod_length, abs=within_mm)


@settings(max_examples=examples(5))
@given(OFF, st.lists(OFF, min_size=2, max_size=2), st.lists(OFF, min_size=3, max_size=3))
def test_heights_show_all_but_the_rods(radius: float, angles: list[float], ends: list[float]) -> None:
    true = off(radius, angles, ends, [0.0] * 3)
    same(fit_delta(CONFIGURED, heights_of(true)), true, 1e-5)


@settings(max_examples=examples(5))
@given(OFF, st.lists(OFF, min_size=2, max_size=2), *[st.lists(OFF, min_size=3, max_size=3) for _ in range(2)])
def test_lengths_show_the_rods(
    radius: float, angles: list[float], ends: list[float], rods: list[float]
) -> None:
    true = off(radius, angles, ends, rods)
    printed = [ways_at(CONFIGURED, (x, y, 0.0)) for x, y in PLACES]
    pairs = [(0, i) for i in range(1, 7)] + [(i, i % 6 + 1) for i in range(1, 7)]
    lengths = [
        Distance(math.dist(nozzle_at(true, printed[i]), nozzle_at(true, printed[j])), printed[i], printed[j])
        for i, j in pairs
    ]
    same(fit_delta(CONFIGURED, heights_of(true), lengths), true, 1e-5)


def test_too_few_places_are_refused() -> None:
    with pytest.raises(ValueError, match="measure at more"):
        fit_delta(CONFIGURED, heights_of(CONFIGURED)[:4])

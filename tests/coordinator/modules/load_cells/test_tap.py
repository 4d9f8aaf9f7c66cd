"""Where a nozzle leaves the bed, by forces that are computed; and filters, by what they do to sines."""

import cmath
import math

import numpy as np
import pytest

from coordinator.modules.load_cells.force_filters import high_pass, low_pass, notch
from coordinator.modules.load_cells.tap import TapError, find_tap
from nodes.devices.analog_trigger import Section

RATE = 320.0
STIFF = 4000.0


def lift(
    corner_mm: float, *, noise_g: float = 0.0, drift: float = 0.0, hum_g: float = 0.0, readings: int = 200
) -> tuple[list[float], list[float], list[float]]:
    """Return times, ways and forces of a lift of 0.2 mm from a bed that is left at CORNER_MM."""
    ways = np.linspace(0, 0.2, readings)
    times = np.arange(readings) / RATE
    forces = STIFF * np.maximum(corner_mm - ways, 0) + drift * times + 300
    forces += hum_g * np.sin(2 * np.pi * 50 * times + 1)
    forces += noise_g * np.random.default_rng(7).standard_normal(readings)
    return list(times), list(ways), list(forces)


@pytest.mark.parametrize("corner_mm", [0.01, 0.05, 0.1, 0.19])
def test_the_corner_is_found_exactly(corner_mm: float) -> None:
    tap = find_tap(*lift(corner_mm, drift=20))
    assert tap.way_mm == pytest.approx(corner_mm, abs=1e-5)
    assert tap.grams_per_mm == pytest.approx(STIFF, rel=1e-3)
    assert tap.scatter_g < 0.1


def test_noise_moves_it_little_and_is_told() -> None:
    tap = find_tap(*lift(0.12, noise_g=2))
    assert tap.way_mm == pytest.approx(0.12, abs=5e-4)
    assert tap.scatter_g == pytest.approx(2, rel=0.15)


def test_a_hum_that_is_known_does_not_move_it() -> None:
    readings = lift(0.12, hum_g=60)
    assert find_tap(*readings, (50, 60)).way_mm == pytest.approx(0.12, abs=1e-5)
    assert abs(find_tap(*readings).way_mm - 0.12) > 1e-4


def test_a_cell_that_is_mounted_the_other_way_round() -> None:
    times, ways, forces = lift(0.12)
    tap = find_tap(times, ways, [-force for force in forces])
    assert tap.way_mm == pytest.approx(0.12, abs=1e-5)
    assert tap.grams_per_mm == pytest.approx(-STIFF, rel=1e-3)


@pytest.mark.parametrize(
    ("readings", "why"),
    [
        (lift(0.1, readings=11), "the lift has 11 readings, and 12 are needed"),
        (lift(0.0, noise_g=1), "that shows no contact"),
        (lift(0.3, noise_g=1), "the nozzle did not leave the bed"),
        (lift(0.004, noise_g=0.01), "at once"),
        (lift(0.197, noise_g=0.01), "only at its end"),
    ],
)
def test_what_is_no_lift_from_a_bed_is_refused(
    readings: tuple[list[float], list[float], list[float]], why: str
) -> None:
    with pytest.raises(TapError, match=why):
        find_tap(*readings)


# ----------------------------------------------------------------------------------------------- filters


def gain(section: Section, frequency_hz: float) -> float:
    """Return by how much a sine comes out larger, by the transfer function."""
    b0, b1, b2, a1, a2 = section
    z = cmath.exp(-2j * math.pi * frequency_hz / RATE)
    return abs((b0 + b1 * z + b2 * z * z) / (1 + a1 * z + a2 * z * z))


@pytest.mark.parametrize("order", [1, 2])
def test_low_and_high_pass_halve_the_power_at_their_cutoff(order: int) -> None:
    low, high = low_pass(20, RATE, order), high_pass(20, RATE, order)
    half = math.sqrt(0.5)
    assert (gain(low, 1e-6), gain(low, 20), gain(low, RATE / 2)) == pytest.approx((1, half, 0), abs=1e-6)
    assert (gain(high, RATE / 2), gain(high, 20), gain(high, 1e-6)) == pytest.approx((1, half, 0), abs=1e-6)
    tenfold = 0.1**order
    assert gain(high, 2) == pytest.approx(tenfold, rel=0.05)


def test_a_notch_takes_out_one_frequency_in_the_width_of_its_quality() -> None:
    section = notch(50, RATE, 2)
    assert gain(section, 50) == pytest.approx(0, abs=1e-9)
    assert (gain(section, 1e-6), gain(section, RATE / 2)) == pytest.approx((1, 1))
    edges = [hz for hz in np.arange(20, 100, 0.1) if gain(section, hz) < math.sqrt(0.5)]
    assert edges[-1] - edges[0] == pytest.approx(25, abs=0.3)

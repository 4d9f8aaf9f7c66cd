"""The point that fits linear equations best, compared with numpy's."""

import numpy as np
import pytest

from coordinator.kinematics.geometry import fit_point


@pytest.mark.parametrize("seed", range(20))
def test_least_squares_is_what_numpy_finds(seed: int) -> None:
    chance = np.random.default_rng(seed)
    rows = chance.normal(0, 1, (chance.integers(3, 9), 3)) * 10.0 ** chance.integers(-3, 3, 3)
    values = chance.normal(0, 100, len(rows))
    wanted = np.linalg.lstsq(rows, values, rcond=None)[0]
    assert fit_point(rows.tolist(), values.tolist()) == pytest.approx(wanted, rel=1e-9)


def test_an_axis_that_no_row_has_is_0() -> None:
    assert fit_point([(1, 1, 0), (1, -1, 0)], [3, 1]) == pytest.approx((2, 1, 0))
    assert fit_point([(0, 0, 2)], [3]) == pytest.approx((0, 0, 1.5))
    assert fit_point([], []) == (0, 0, 0)


def test_what_depends_on_axes_before_it_is_0() -> None:
    x, y, z = fit_point([(1, 2, 0), (2, 4, 1)], [5, 11])
    assert (x, y) == pytest.approx((5, 0))
    assert z == pytest.approx(1)

"""Symmetric equations, compared with numpy's."""

import numpy as np
import pytest

from nodes.support.linear import cholesky, inverse, solve


@pytest.mark.parametrize("size", [1, 2, 3, 4])
@pytest.mark.parametrize("seed", range(10))
def test_solutions_and_inverses_are_numpys(size: int, seed: int) -> None:
    chance = np.random.default_rng(seed)
    rows, scales = chance.normal(0, 1, (size + 2, size)), 10.0 ** chance.uniform(-4, 4, size)
    matrix = (rows.T @ rows) * np.outer(scales, scales)
    values = chance.normal(0, 1, size)
    lower = np.array([[*row, *([0.0] * (size - len(row)))] for row in cholesky(matrix.tolist())])
    assert lower @ lower.T == pytest.approx(matrix, rel=1e-9)
    assert solve(matrix.tolist(), values.tolist()) == pytest.approx(np.linalg.solve(matrix, values), rel=1e-7)
    found = np.array(inverse(matrix.tolist()))
    assert found == pytest.approx(np.linalg.inv(matrix), rel=1e-7)
    assert np.array_equal(found, found.T)


def test_what_is_not_positive_definite_is_refused() -> None:
    with pytest.raises(ValueError, match="math domain error"):
        solve([[1.0, 2.0], [2.0, 1.0]], [0.0, 0.0])

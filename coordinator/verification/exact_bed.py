"""The shape of a bed, evaluated independently of step generation: power series of each patch, for arrays."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coordinator.motion.steps.surface import Surface
from coordinator.verification.exact_signal import Floats

# A cubic on 0..1 from its value and slope at 0, then at 1: rows are powers, columns these four.
_CUBIC = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [-3, -2, 3, -1], [2, 1, -2, 1]], dtype=float)


class ExactBed:
    """What a surface adds to Z, and how that changes with each axis."""

    def __init__(self, surface: Surface) -> None:
        nodes = np.asarray(surface.nodes)
        self._corner = np.array(surface.origin_mm)
        self._spacing = np.array(surface.spacing_mm)
        self.full_below, self.none_above, self._target = surface.fade_mm
        rows, columns = nodes.shape[:2]
        self._patches = np.array([columns - 1, rows - 1])
        self._powers = np.empty((rows - 1, columns - 1, 4, 4))
        for row in range(rows - 1):
            for column in range(columns - 1):
                self._powers[row, column] = self._patch(nodes[row : row + 2, column : column + 2])

    def _patch(self, corners: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return coefficients [power of x, power of y] of a patch on 0..1 from its CORNERS [y, x, 4]."""
        width, depth = self._spacing
        known = np.empty((4, 4))  # [value or slope by x at 0 and 1, the same by y]
        for y in range(2):
            for x in range(2):
                height, by_x, by_y, twist = corners[y, x]
                known[2 * x : 2 * x + 2, 2 * y : 2 * y + 2] = [
                    [height, by_y * depth],
                    [by_x * width, twist * width * depth],
                ]
        return np.asarray(_CUBIC @ known @ _CUBIC.T)

    def height(self, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the height (mm) at places, and its slopes by X and Y."""
        at = (np.stack((x, y)) - self._corner[:, None]) / self._spacing[:, None]
        inside = (at >= 0) & (at <= self._patches[:, None])
        at = np.clip(at, 0, self._patches[:, None])
        column, row = np.minimum(at.astype(int), self._patches[:, None] - 1)
        u, v = at - (column, row)
        powers = self._powers[row, column]
        up, vp = u[:, None] ** np.arange(4), v[:, None] ** np.arange(4)
        zero = np.zeros((len(u), 1))
        u_slope = np.concatenate((zero, up[:, :3] * (1, 2, 3)), axis=1)
        v_slope = np.concatenate((zero, vp[:, :3] * (1, 2, 3)), axis=1)
        z = np.einsum("ni,nij,nj->n", up, powers, vp)
        by_x = np.einsum("ni,nij,nj->n", u_slope, powers, vp) / self._spacing[0]
        by_y = np.einsum("ni,nij,nj->n", up, powers, v_slope) / self._spacing[1]
        return z, np.where(inside[0], by_x, 0), np.where(inside[1], by_y, 0)

    def motor_z(self, x: Floats, y: Floats, z: Floats) -> Floats:
        """Return where Z has to be so that the planned place is reached."""
        fade, _ = self._fade(z)
        moved: Floats = z + self._target + fade * (self.height(x, y)[0] - self._target)
        return moved

    def motor_speed(self, at: Sequence[Floats], speed: Sequence[Floats]) -> Floats:
        """Return the speed of Z at planned places AT (x, y, z) with planned speeds."""
        height, by_x, by_y = self.height(at[0], at[1])
        fade, by_z = self._fade(at[2])
        slope: Floats = speed[2] + fade * (by_x * speed[0] + by_y * speed[1])
        return slope + by_z * speed[2] * (height - self._target)

    def _fade(self, z: Floats) -> tuple[Floats, Floats]:
        if not np.isfinite(self.none_above):
            return np.ones_like(z), np.zeros_like(z)
        width = self.none_above - self.full_below
        share = (self.none_above - z) / width
        return np.clip(share, 0, 1), np.where((share > 0) & (share < 1), -1 / width, 0.0)

    def patches_passed(self, x: Floats, y: Floats) -> Floats:
        """Return how many patches' widths lie between each place and the next."""
        across = np.abs(np.diff(x)) / self._spacing[0]
        along = np.abs(np.diff(y)) / self._spacing[1]
        return np.asarray(across + along)

"""The shape of a bed, as step generation follows it (the manual is step_surface.h)."""

import math
from collections.abc import Sequence
from itertools import chain
from typing import Any, Final

from coordinator.motion.steps._steps import ffi, lib
from coordinator.motion.steps.errors import StepError

NODES_MAX: Final = int(lib.STEP_SURFACE_POINTS)
_NODE_VALUES: Final = 4
NO_FADE: Final = (math.inf, math.inf, 0.0)


class Surface:
    """A bicubic surface over X and Y, added to Z; never changed.

    NODES: rows of X, 2 to 256 nodes both ways, of four numbers each: height (mm), its slopes by X and by Y,
    its twist (by both, 1/mm). FADE_MM: the planned Z up to which all of it acts, the one from which only the
    third value is added, and that (infinite: all acts at any height). Raises StepError when it can be no
    bed's.
    """

    def __init__(
        self,
        origin_mm: tuple[float, float],
        spacing_mm: tuple[float, float],
        nodes: Sequence[Sequence[Sequence[float]]],
        fade_mm: tuple[float, float, float] = NO_FADE,
    ) -> None:
        self.origin_mm = origin_mm
        """X and Y of the first node."""
        self.spacing_mm = spacing_mm
        """Of nodes along X and along Y."""
        self.fade_mm = fade_mm
        rows, columns = len(nodes), len(nodes[0])
        # A copy: no view of the caller's memory may outlive this call (tests/test_borrowed_memory.py).
        self._memory: Any = ffi.new("double[]", [*chain.from_iterable(chain.from_iterable(nodes))])
        self.nodes: memoryview[float] = memoryview(ffi.buffer(self._memory)).cast(
            "d", (rows, columns, _NODE_VALUES)
        )
        """The nodes; rows of X, of four numbers each."""
        grid: Any = ffi.new("struct step_surface *")
        grid.points_y, grid.points_x = rows, columns
        grid.from_x, grid.from_y = origin_mm
        grid.step_x, grid.step_y = spacing_mm
        grid.fade_from, grid.fade_to, grid.fade_target = fade_mm
        grid.nodes = self._memory
        self.grid = grid
        """The same for C."""
        if not lib.step_surface_is_legal(self.grid):
            raise StepError(
                f"the shape of the bed is refused: it has to be a grid of 2 to {NODES_MAX} points both ways,"
                " at least 0.1 mm apart, whose height nowhere changes by more than 0.5 mm per mm, also where"
                " it fades; probe the bed again, or let it fade over more height"
            )
        self._patches: Any = ffi.new("double[]", 16 * (rows - 1) * (columns - 1))
        lib.step_surface_make_patches(self.grid, self._patches)
        self.grid.patches = self._patches

    @property
    def steepest(self) -> float:
        """A slope (mm per mm) that it exceeds nowhere."""
        return float(lib.step_surface_steepest(self.grid))

    def motor_z(self, x: float, y: float, z: float) -> float:
        """Return where Z has to be for the planned place, mm."""
        return float(lib.step_surface_motor_z(self.grid, x, y, z))

    def planned_z(self, x: float, y: float, motor_z: float) -> float:
        """Return the planned Z of a place to which the motors went, mm."""
        return float(lib.step_surface_planned_z(self.grid, x, y, motor_z))

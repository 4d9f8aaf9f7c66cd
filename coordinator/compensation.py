"""Which axis tables step generation uses: taken up and removed at standstill, on homed axes only.

The control loop says which tables are wanted; the motion worker takes them up when it may. A table that is
taken up makes no step by itself: docs/tables.md tells how it comes into effect.
"""

import math
from collections.abc import Mapping
from typing import Final

from coordinator.machine.description import MachineDescription
from coordinator.motion.planner_values import Limits
from coordinator.motion.specs import StepKinematics
from coordinator.motion.steps import TABLE_POINTS_MAX, AxisCorrection, StepGenerator
from coordinator.table.axis_table import AxisTable, TableError
from nodes.records import record

AXES: Final = "xyz"
NO_CORRECTION: Final = AxisCorrection(0, reverse=False, offset_mm=0.0, lag_mm=0.0)
Z_SHARE: Final = 0.2
"""Of Z's top speed, at which Z takes up what a correction jumps by: screws start at no more at once."""


@record
class AxisState:
    """For front ends: what is done with the table of an axis."""

    applied: bool
    """Whether step generation uses the table that is wanted; with none wanted, whether it uses none."""
    side: str
    """"forward", "reverse", or empty without a table."""
    offset_mm: float
    """What is added where the last planned move ends."""
    lag_mm: float
    """The part of it that will fade, since the side or the table has changed."""


class Compensation:
    """The tables of a machine whose planner has LIMITS. ``want`` and ``states`` may be used by another thread."""

    def __init__(self, limits: Limits) -> None:
        self.wanted: Mapping[str, AxisTable] = {}
        """By axis letter; replaced as a whole, never changed."""
        self._taken: dict[str, AxisTable] = {}
        self._looked_at: tuple[Mapping[str, AxisTable], str] = (self.wanted, "")
        self._carried: tuple[AxisCorrection, ...] | None = None
        at_once = limits.square_corner_velocity
        self._take_up_mm_s = (at_once, at_once, min(at_once, Z_SHARE * limits.max_z_velocity))
        self.states: Mapping[str, AxisState] = {}

    def want(self, axis: str, table: AxisTable | None) -> None:
        """Have TABLE taken up on AXIS (a letter), or its table removed, as soon as that may be."""
        others = {name: kept for name, kept in self.wanted.items() if name != axis}
        self.wanted = others if table is None else {**others, axis: table}

    def is_due(self, homed: str) -> bool:
        """Tell whether ``take_up`` has something to do, with the axes HOMED (capital letters)."""
        return self._looked_at != (self.wanted, homed) and self._looked_at_otherwise(homed)

    def _looked_at_otherwise(self, homed: str) -> bool:
        return any(self._may_use(axis, homed) is not self._taken.get(axis) for axis in AXES)

    def _may_use(self, axis: str, homed: str) -> AxisTable | None:
        return self.wanted.get(axis) if axis.upper() in homed else None

    def take_up(self, steps: StepGenerator, homed: str) -> None:
        """Give STEPS, all of whose moves are generated, the tables of HOMED axes; raises StepError."""
        wanted = self.wanted
        for number, axis in enumerate(AXES):
            table = self._may_use(axis, homed)
            if table is self._taken.get(axis):
                continue
            values = ((), (), ()) if table is None else (table.positions, table.forward, table.reverse)
            steps.set_table(number, *values, take_up_mm_s=self._take_up_mm_s[number])
            if table is not None:
                self._taken[axis] = table
                continue
            del self._taken[axis]
            if axis.upper() not in homed:  # nobody knows where it stands: nothing is left to be undone
                kept = list(steps.corrections)
                kept[number] = NO_CORRECTION
                steps.set_corrections(kept)
        self._looked_at = (wanted, homed)
        self.note(steps)

    def begin_again(self, before: StepGenerator) -> None:
        """Take note that another generator follows on BEFORE: it has no tables, and the motors did not move."""
        self._carried = before.corrections
        self._taken = {}

    def declared(self, steps: StepGenerator, before: tuple[AxisCorrection, ...], homed: str) -> None:
        """Let the axes that were not just HOMED (capital letters) keep what they had BEFORE STEPS were told
        where they stand.
        """
        kept, self._carried = self._carried or before, None
        if any(correction.offset_mm for correction in kept):
            steps.set_corrections(
                [NO_CORRECTION if axis.upper() in homed else kept[i] for i, axis in enumerate(AXES)]
            )

    def note(self, steps: StepGenerator) -> None:
        """Have ``states`` tell what STEPS do now."""
        self.states = {
            axis: AxisState(
                self._taken.get(axis) is self.wanted.get(axis),
                ("reverse" if found.reverse else "forward") if found.points else "",
                found.offset_mm,
                found.lag_mm,
            )
            for axis, found in zip(AXES, steps.corrections, strict=True)
        }


def check_compensable(description: MachineDescription, table: AxisTable) -> None:
    """Raise TableError unless the coordinator can correct the axis of TABLE."""
    if table.axis not in AXES or description.carriages is not None or not _is_linear(description):
        raise TableError(
            f"axis {table.axis} cannot have a table: only x, y and z of machines whose steppers move in "
            "proportion to them are corrected, not towers, arms, winches or dual carriages"
        )
    if len(table.positions) > TABLE_POINTS_MAX:
        raise TableError(
            f"the table of axis {table.axis} has {len(table.positions)} points, and step generation has room "
            f"for {TABLE_POINTS_MAX}; thin it out"
        )

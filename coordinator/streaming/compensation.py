"""Which axis tables step generation uses: taken up and removed at standstill, on homed axes only.

The control loop says which tables are wanted; the motion worker takes them up when it may. A table that is
taken up makes no step by itself: see docs/tables.md for how it takes effect.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final

from coordinator.config.model import MachineDescription
from coordinator.motion.specs import MotionLimits
from coordinator.motion.steps.steps import TABLE_POINTS_MAX, AxisCorrection, StepGenerator
from coordinator.tables.axis_table import AxisTable, Unit

AXES: Final = "xyz"
WHICH_AXES: Final = (
    "x, y and z of machines whose steppers move in proportion to them, without towers, arms, winches or dual "
    "carriages"
)
NO_CORRECTION: Final = AxisCorrection(0, reverse=False, offset_mm=0.0, lag_mm=0.0)
Z_SHARE: Final = 0.2
"""Of Z's top speed, at which Z takes up what a correction jumps by: screws start at no more at once."""


@dataclass(frozen=True, slots=True)
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
    """The tables of a machine whose planner has LIMITS.

    ``want`` and ``states`` may be used by another thread than the rest.
    """

    def __init__(self, limits: MotionLimits) -> None:
        self.wanted: Mapping[str, AxisTable] = {}
        """By axis letter; replaced as a whole, never changed."""
        self._taken: dict[str, AxisTable] = {}
        self._looked_at: tuple[Mapping[str, AxisTable], str] = (self.wanted, "")
        self._carried: tuple[AxisCorrection, ...] | None = None
        at_once = limits.square_corner_velocity
        self._take_up_mm_s = (at_once, at_once, min(at_once, Z_SHARE * limits.max_z_velocity))
        self.states: Mapping[str, AxisState] = {}
        self.on_want: Callable[[], None] = lambda: None
        """Called by ``want``."""

    def want(self, axis: str, table: AxisTable | None) -> None:
        """Take TABLE up on AXIS (a letter), or remove its table, as soon as that is possible."""
        others = {name: kept for name, kept in self.wanted.items() if name != axis}
        self.wanted = others if table is None else {**others, axis: table}
        if (state := self.states.get(axis)) is not None:  # before the next cycle says so
            applied = self._taken.get(axis) is self.wanted.get(axis)
            self.states = {**self.states, axis: replace(state, applied=applied)}
        self.on_want()

    def is_due(self, homed: str) -> bool:
        """Return whether ``take_up`` has something to do, with the axes HOMED (capital letters)."""
        if self._looked_at == (self.wanted, homed):  # most of the time: the same map
            return False
        due = any(self._may_use(axis, homed) is not self._taken.get(axis) for axis in AXES)
        if not due:
            self._looked_at = (self.wanted, homed)
        return due

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
            if axis.upper() not in homed:  # its position is unknown: nothing is left to be undone
                kept = list(steps.corrections)
                kept[number] = NO_CORRECTION
                steps.set_corrections(kept)
        self._looked_at = (wanted, homed)
        self.note(steps)

    def begin_again(self, before: StepGenerator) -> None:
        """Record that another generator, without tables, replaces BEFORE; no motor moved."""
        self._carried = before.corrections
        self._taken = {}
        self._looked_at = ({}, "")

    def declared(self, steps: StepGenerator, before: tuple[AxisCorrection, ...], homed: str) -> None:
        """Keep the corrections of axes that were not just HOMED (capital letters).

        The position of STEPS was set; BEFORE are the corrections until then.
        """
        kept, self._carried = self._carried or before, None
        if any(correction.offset_mm for correction in kept):
            steps.set_corrections(
                [NO_CORRECTION if axis.upper() in homed else kept[i] for i, axis in enumerate(AXES)]
            )

    def note(self, steps: StepGenerator) -> None:
        """Update ``states`` from STEPS."""
        self.states = {
            axis: AxisState(
                self._taken.get(axis) is self.wanted.get(axis),
                ("reverse" if found.reverse else "forward") if found.points else "",
                found.offset_mm,
                found.lag_mm,
            )
            for axis, found in zip(AXES, steps.corrections, strict=True)
        }


def corrected_axes(description: MachineDescription) -> str:
    """Return the letters of the axes that the coordinator can correct by tables; empty: none of this kind."""
    linear = all(motor.function.linear for motor in description.motors)
    return AXES if linear and description.dual_carriage is None else ""


def why_not_corrected(description: MachineDescription, table: AxisTable) -> str:
    """Return why the coordinator cannot correct the axis of TABLE, a sentence; empty: it can."""
    if table.axis not in tuple(corrected_axes(description)):
        return f"axis {table.axis} is not corrected: that is for {WHICH_AXES}"
    if table.unit is not Unit.MM:
        return f"axis {table.axis} is not corrected: its table is in degrees, the axis moves in mm"
    if len(table.positions) > TABLE_POINTS_MAX:
        return (
            f"axis {table.axis} is not corrected: its table has {len(table.positions)} points, and step "
            f"generation has room for {TABLE_POINTS_MAX}; thin it out"
        )
    return ""

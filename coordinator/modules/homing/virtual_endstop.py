"""Endstops that are no switches: what a homing move has to do before and after it looks at one."""

from contextlib import AbstractAsyncContextManager, nullcontext

from coordinator.gcode.commands import Call, Lines
from coordinator.modules.base import Module


class StallEndstop(Module):
    """A module that feels when its motor stands against something, and raises a pin then."""

    def feeling(self, speed: float) -> AbstractAsyncContextManager[None]:
        """Return what makes it feel while the axis moves at SPEED (mm/s), and puts back what was before.

        Raises CanductorError.
        """
        raise NotImplementedError


class ProbeEndstop(Module):
    """A module whose probe may be the endstop of Z."""

    def touching(self, *, alone: bool) -> AbstractAsyncContextManager[None]:
        """Return what makes it ready for one way down, from where the head stands, and puts it away after.

        ALONE: no other way down of the same command follows. Raises CanductorError.
        """
        del alone
        return nullcontext()

    @property
    def probing_accel(self) -> float | None:
        """Acceleration of the way down at most, mm/s²; None: any."""
        return None

    async def standing_mm(self) -> float | None:
        """Measure how high the nozzle is above the bed where the head stands; None: it feels a trigger only.

        Raises CanductorError.
        """
        return None

    @property
    def has_lines(self) -> bool:
        """Whether lines of g-code are run before or after a move towards it."""
        raise NotImplementedError

    def lines_before(self, call: Call) -> Lines:
        """Return the lines that make it ready."""
        raise NotImplementedError

    def lines_after(self, call: Call) -> Lines:
        """Return the lines that put it away."""
        raise NotImplementedError


def section_of(virtual_endstop: str) -> str:
    """Return the name of the section that a virtual endstop belongs to.

    >>> section_of("tmc2209_stepper_x:virtual_endstop")
    'tmc2209 stepper_x'
    """
    return virtual_endstop.partition(":")[0].replace("_", " ", 1)

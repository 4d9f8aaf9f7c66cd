"""Endstops that are no switches: what a homing move has to do before and after it looks at one."""

from contextlib import AbstractAsyncContextManager

from coordinator.modules.base import Module


class StallEndstop(Module):
    """A module that feels when its motor stands against something, and raises a pin then."""

    def feeling(self, speed: float) -> AbstractAsyncContextManager[None]:
        """Return what makes it feel while the axis moves at SPEED (mm/s), and puts back what was before.

        Raises CanductorError.
        """
        raise NotImplementedError


def section_of(virtual_endstop: str) -> str:
    """Return the name of the section that a virtual endstop belongs to.

    >>> section_of("tmc2209_stepper_x:virtual_endstop")
    'tmc2209 stepper_x'
    """
    return virtual_endstop.partition(":")[0].replace("_", " ", 1)

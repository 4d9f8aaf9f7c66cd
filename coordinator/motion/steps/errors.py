"""The error of step generation."""

from nodes.support.errors import CanductorError


class StepError(CanductorError):
    """Step generation cannot go on; the sentence says where and why."""

    print_time_s: float | None = None
    """Of the step or move that cannot be; None: it is no matter of time."""

"""The extreme values that the configuration accepts, and options that are bounded by them alone.

They are far beyond any machine, and near enough that squares and sums stay exact and a slipped digit group is
noticed.
"""

from coordinator.config.options import FloatOption

MAX_SPEED = 100_000.0
"""mm/s."""
MIN_SPEED = 0.001
"""mm/s; the planner calculates with none below it (motion/planner/values.py)."""
MAX_ACCEL = 10_000_000.0
"""mm/s²."""
MIN_ACCEL = 0.001
"""mm/s²; as MIN_SPEED."""
MAX_POSITION = 100_000.0
"""mm: a hundred metres; positions stay exact to far below a step."""
MAX_BELT_POSITION = 1e9
"""mm: the end of an axis that has none, of a machine with a belt for its bed."""


def speed_option(name: str, text: str, default: float | None = None) -> FloatOption:
    """Return the option NAME for a speed that is not 0; TEXT is its help."""
    return FloatOption(
        name=name, help=text, default=default, unit="mm/s", minimum=MIN_SPEED, maximum=MAX_SPEED
    )


def accel_option(name: str, text: str, default: float | None = None) -> FloatOption:
    """Return the option NAME for an acceleration that is not 0; TEXT is its help."""
    return FloatOption(
        name=name, help=text, default=default, unit="mm/s²", minimum=MIN_ACCEL, maximum=MAX_ACCEL
    )


def length_option(name: str, text: str) -> FloatOption:
    """Return the option NAME for a length above 0; TEXT is its help."""
    return FloatOption(name=name, help=text, unit="mm", above=0, maximum=MAX_POSITION)


def position_option(name: str, text: str, default: float | None = None) -> FloatOption:
    """Return the option NAME for a position on an axis; TEXT is its help."""
    return FloatOption(
        name=name, help=text, default=default, unit="mm", minimum=-MAX_POSITION, maximum=MAX_POSITION
    )

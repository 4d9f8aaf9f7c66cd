"""The highest values that the configuration accepts.

They are far above any machine, and low enough that squares and sums stay exact and a slipped digit group is
noticed.
"""

MAX_SPEED = 100_000.0
"""mm/s."""
MAX_ACCEL = 10_000_000.0
"""mm/s²."""
MAX_POSITION = 100_000.0
"""mm: a hundred metres; positions stay exact to far below a step."""
MAX_BELT_POSITION = 1e9
"""mm: the end of an axis that has none, of a machine with a belt for its bed."""

"""Division of the slots of a node's move queue between its steppers and its timed outputs.

A slot is taken by a queued step command until its last step, and by a queued value of an output until its
clock. Queuing without a free slot shuts the node down, so each side keeps to its own part.
"""

from typing import Final

OUTPUT_SLOTS_MAX: Final = 16
"""Most slots of one output: more values are rarely queued at once, and steps need the slots more."""
OUTPUT_SLOTS_MIN: Final = 3
"""Least slots of one output: a heater is renewed every 0.3 s, 0.4 s ahead, and may be turned off between."""
OUTPUTS_SHARE: Final = 4
"""All outputs together have one part in so many of the queue, where that covers their minimum."""
STEP_SLOTS_MIN: Final = 4


def share_slots(move_count: int, outputs: int) -> tuple[int, int]:
    """Return how many of MOVE_COUNT slots go to the steppers, and to each of OUTPUTS; at least 1 each."""
    if not outputs:
        return move_count, 0
    wanted = min(max(move_count // OUTPUTS_SHARE // outputs, OUTPUT_SLOTS_MIN), OUTPUT_SLOTS_MAX)
    each = max(min(wanted, (move_count - STEP_SLOTS_MIN) // outputs), 1)
    return max(move_count - each * outputs, 1), each

"""By how much screws are turned: against a bed whose screws are turned by that."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.modules.levelling.screw_turns import PITCH_MM, THREADS, Turn, screw_turns

HEIGHTS = st.lists(st.floats(-3, 3), min_size=3, max_size=6)


def turned(turn: Turn, thread: str) -> float:
    """Return where the bed is when its knob was turned so, as the clock's face says."""
    way, _, size = thread.partition("-")
    full, minutes = turn.adjust.split(":")
    up = 1 if turn.direction == way else -1
    return turn.height + up * (int(full) + int(minutes) / 60) * PITCH_MM[size]


@given(HEIGHTS, st.sampled_from(THREADS), st.sampled_from(["", "CW", "CCW"]))
def test_turned_screws_are_level(heights: list[float], thread: str, direction: str) -> None:
    turns = screw_turns(heights, thread, direction)
    (base,) = [turn.height for turn in turns if turn.is_base]
    minute_mm = PITCH_MM[thread.partition("-")[2]] / 60
    assert [turned(turn, thread) for turn in turns] == pytest.approx(
        [base] * len(turns), abs=0.501 * minute_mm
    )
    if direction:
        assert {turn.direction for turn in turns if turn.adjust != "00:00"} <= {direction}
    else:
        assert base == heights[0]


def test_a_turn_and_a_quarter_is_15_minutes_past_one() -> None:
    turns = screw_turns([2.0, 1.375, 2.6249, 1.5021], "CW-M3")
    told = [(turn.direction, turn.adjust) for turn in turns]
    assert told == [("CW", "00:00"), ("CW", "01:15"), ("CCW", "01:15"), ("CW", "01:00")]
    (turn,) = [turn for turn in screw_turns([2.0, 1.3, 2.0], "CCW-M4") if turn.adjust != "00:00"]
    assert (turn.direction, turn.adjust) == ("CCW", "01:00")

"""What a streaming driver needs: little is planned beyond where it asked for, however long the moves are."""

import pytest

from coordinator.assembly.load import load_machine
from coordinator.motion.planner.planner import FeedStatus, Planner
from coordinator.support.examples import DEMO_MACHINE


@pytest.mark.parametrize(("speed_mm_min", "most"), [(600, 3), (1200, 3), (12000, 6)])
def test_long_moves_do_not_pile_up_unplanned(speed_mm_min: int, most: int) -> None:
    planner = Planner(load_machine(str(DEMO_MACHINE)).limits)
    planner.homed = "XYZ"
    text = f"G1 F{speed_mm_min}\n".encode() + b"G1 X200\nG1 X10\n" * 30
    planner.plan_until_s = 3.0
    feed = planner.feed(text, 0, len(text), final=False)
    assert feed.status is FeedStatus.FULL
    longest_s = 190 / (speed_mm_min / 60) + 0.2
    assert planner.moves <= 3.0 / longest_s + most
    assert planner.flush()
    assert planner.print_time_end_s < 3.0 + most * longest_s


def test_the_plan_does_not_depend_on_when_it_is_made() -> None:
    """One planner is asked to plan after every line, the other decides for itself."""
    text = b"".join(
        b"G1 X%d Y%d F%d\n" % (i * 37 % 200, i * 53 % 200, 600 + i * 777 % 12000) for i in range(300)
    )
    ends = []
    for eager in (False, True):
        planner = Planner(load_machine(str(DEMO_MACHINE)).limits)
        planner.homed = "XYZ"
        at = 0
        while at < len(text):
            end = text.index(b"\n", at) + 1 if eager else len(text)
            feed = planner.feed(text, at, end, final=False)
            at = feed.offset
            if eager:
                planner.plan()
            if feed.status is FeedStatus.FULL:
                planner.release(planner.take().count)
        planner.flush()
        ends.append(planner.print_time_end_s)
    assert ends[0] == ends[1]

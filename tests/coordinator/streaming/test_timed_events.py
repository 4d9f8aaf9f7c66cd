"""What is to be done in time is done near its time, and in the program's order."""

from coordinator.gcode.events import AS_SOON_AS_POSSIBLE, Timed
from coordinator.streaming.timed_events import AHEAD_S, DueEvents


def event(line: int, *, at_once: bool = False) -> Timed:
    return Timed(line, AS_SOON_AS_POSSIBLE if at_once else line, lambda _: None)


def lines(due: list[tuple[float, Timed]]) -> list[int]:
    return [timed.line for _, timed in due]


def test_an_event_waits_until_its_time_is_near() -> None:
    events = DueEvents()
    assert lines(events.take(10.0, [(12.0, event(1)), (30.0, event(2))])) == []
    assert lines(events.take(12.0 - AHEAD_S, [])) == [1]
    assert lines(events.take(28.0, [(29.5, event(3))])) == []
    assert lines(events.take(29.0, [])) == [2, 3]  # the order is the program's
    assert lines(events.rest()) == []


def test_what_is_late_is_done_at_once() -> None:
    assert lines(DueEvents().take(10.0, [(9.0, event(1)), (10.1, event(2))])) == [1, 2]


def test_what_somebody_wants_at_once_is_not_undone_by_what_was_read_before() -> None:
    events = DueEvents()
    events.take(10.0, [(20.0, event(1)), (25.0, event(2))])
    new = [(30.0, event(3)), (0.0, event(4, at_once=True)), (40.0, event(5))]
    assert lines(events.take(11.0, new)) == [1, 2, 3, 4]
    assert lines(events.take(12.0, [])) == []
    assert lines(events.rest()) == [5]

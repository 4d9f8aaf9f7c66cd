"""Where in the file a job is: from the line that is carried out, and what was read when."""

import random

from coordinator.service.jobs.jobs import TRAIL_MAX, Trail


def test_bytes_follow_the_line_that_is_carried_out() -> None:
    trail = Trail()
    trail.look(0, 0, 0)
    trail.look(100, 3000, 0)
    assert trail.done_bytes == 0
    trail.look(200, 5000, 1)
    assert trail.done_bytes == 0
    trail.look(200, 5000, 51)
    assert trail.done_bytes == 1500
    trail.look(200, 5000, 101)
    assert trail.done_bytes == 3000
    trail.look(200, 5000, 151)
    assert trail.done_bytes == 4000
    trail.look(200, 5000, 120)  # a move back in time there is none
    assert trail.done_bytes == 4000
    trail.look(200, 5000, 201)
    assert trail.done_bytes == 5000


def test_it_is_near_the_truth_and_bounded_whatever_is_read_when() -> None:
    chance = random.Random(5)
    begins = [0]  # of each line of a file
    for _ in range(40_000):
        begins.append(begins[-1] + chance.choice((1, 2, 20, 30, 40)))
    trail, read, line, before = Trail(), 0, 0, 0
    while line < 40_000:
        read = min(40_000, read + chance.randrange(60))
        line = max(line, min(read, read - chance.randrange(2000)))
        line = 40_000 if read == 40_000 else line
        trail.look(read, begins[read], line)
        assert before <= trail.done_bytes <= begins[read]
        assert abs(trail.done_bytes - begins[max(0, line - 1)]) < 2500
        before = trail.done_bytes
    assert len(trail._places) <= TRAIL_MAX


def test_a_file_of_comments_that_is_read_far_ahead_takes_no_more_room() -> None:
    trail = Trail()
    for number in range(1, 100_000):
        trail.look(number * 10, number * 100, 5)
    assert len(trail._places) == TRAIL_MAX
    assert trail.done_bytes == 40
    trail.look(999_990, 9_999_900, 999_990)
    assert abs(trail.done_bytes - 9_999_890) <= 10

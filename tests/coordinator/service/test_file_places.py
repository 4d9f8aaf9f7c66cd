"""Where the lines of a job's file begin, while it is read in pieces ahead of what is carried out."""

import random

import pytest

from coordinator.service.jobs.file_places import LINES_MAX, FilePlaces


def begins_of(text: bytes) -> list[int]:
    """Return where each line begins, from line 1 on."""
    begins = [0]
    for line in text.splitlines(keepends=True):
        begins.append(begins[-1] + len(line))
    return begins


@pytest.mark.parametrize("ends_with_a_line_feed", [True, False])
def test_every_place_is_exact_whatever_is_read_when(*, ends_with_a_line_feed: bool) -> None:
    chance = random.Random(5)
    text = b"\n".join(b"G1" * chance.choice((0, 1, 10, 15, 20)) for _ in range(20_000))
    text += b"\n" if ends_with_a_line_feed else b"M2"
    begins, places = begins_of(text), FilePlaces()
    lines = len(begins) - 1
    given, read, line = 0, 0, 0
    places.add(b"", 0)
    while line < lines:
        if begins[min(lines, read + 100)] > given or read == lines:
            size = chance.randrange(1, 4000)
            places.add(text[given : given + size], given)
            given = min(len(text), given + size)
        while read < lines and begins[read + 1] <= given and chance.random() < 0.99:
            read += 1
        in_a_macro = read > 0 and read < lines and chance.random() < 0.3
        places.read(read - in_a_macro, begins[read])
        line = lines if read == lines else max(line, min(read, read - chance.randrange(2000)))
        if line:
            assert places.begin_of(line) == begins[line - 1]
            places.forget_before(begins[line - 1])
        if read:
            assert places.begin_before(begins[read]) == begins[read - 1]


def test_a_job_that_is_resumed_begins_within_its_file() -> None:
    places = FilePlaces()
    places.add(b"G1 X1\nG1 X2\n", 3000)  # what was read when line 101 was found
    places.read(100, 3000)
    assert [places.begin_of(line) for line in (100, 101, 102)] == [None, 3000, 3006]
    places.add(b"G1 X3\n", 3012)
    places.read(103, 3018)
    assert places.begin_of(103) == 3012


def test_a_file_of_comments_that_is_read_far_ahead_takes_bounded_room() -> None:
    places, piece = FilePlaces(), b";\n" * 30_000
    for number in range(40):
        places.add(piece, number * len(piece))
    places.read(1_200_000, 2_400_000)
    kept = sum(len(piece.ends) for piece in places._pieces if piece.ends is not None)
    assert LINES_MAX - 30_000 < kept <= LINES_MAX
    for line in (1, 2, 250_000, 500_001, 1_199_999):
        assert places.begin_of(line) == 2 * (line - 1)

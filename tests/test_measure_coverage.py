"""What `make coverage` prints, and when it fails."""

import pytest

from tests.measure_coverage import C_BOUND, PYTHON_BOUND, Source, least, percent, ranges, table


def source(run: int, missed: int) -> Source:
    return Source(set(range(1, run + 1)), set(range(run + 1, run + missed + 1)))


def test_neighbouring_lines_are_one_range() -> None:
    assert ranges({9, 3, 7, 8}) == "3, 7-9"
    assert ranges(()) == ""


def test_the_share_is_of_lines_not_of_files() -> None:
    assert percent([source(90, 0), source(0, 10)]) == 90.0
    assert percent([]) == 100.0


@pytest.mark.parametrize(
    ("c_run", "python_run", "kept"),
    [(C_BOUND, PYTHON_BOUND, True), (C_BOUND - 1, 100, False), (100, PYTHON_BOUND - 1, False)],
)
def test_the_table_names_what_is_missing_and_keeps_the_bounds(
    c_run: float, python_run: float, kept: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    c = {
        "firmware/core/sched.c": source(int(c_run), 100 - int(c_run)),
        "firmware/boards/linux/main.c": source(0, 100),  # no bound is set for it
    }
    python = {"nodes/node/node.py": source(int(python_run), 100 - int(python_run))}
    assert table(c, python, verbose=True) is kept
    printed = capsys.readouterr().out
    assert f"C of these{100:>32}{int(c_run):>8}" in printed
    assert f"Python{100:>36}{int(python_run):>8}" in printed
    assert "not run: 1-100" in printed
    if c_run < 100:
        assert f"not run: {ranges(range(int(c_run) + 1, 101))}" in printed


def test_the_least_covered_files_come_first_and_complete_ones_not_at_all() -> None:
    sources = {"a.py": source(5, 5), "b.py": source(1, 9), "c.py": source(7, 0)}
    assert [line.split()[-1] for line in least(sources, verbose=False)] == ["b.py", "a.py"]

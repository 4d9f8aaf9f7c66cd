"""The journal of jobs: whatever cuts it off, what it says is true."""

import json
import os
import stat
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from coordinator.service.jobs.journal import FILE_BYTES_MAX, NAME, Interrupted, Journal, read_journal


def written(folder: Path, *entries: tuple[int, Mapping[str, object]], ended: bool = False) -> Path:
    failures: list[str] = []
    journal = Journal(folder / NAME, failures.append)
    journal.begin("part.gcode", 1000, 77)
    for line, held in entries:
        journal.note(line, held)
    if ended:
        journal.end()
    journal.close(None)
    assert not failures
    return folder / NAME


def test_the_last_line_is_known(tmp_path: Path) -> None:
    held = {"offset": [0, 0, 0.1, 0], "heaters": {"extruder": 210.0}}
    found = read_journal(written(tmp_path, (5, {}), (9, held)))
    assert found == Interrupted("part.gcode", 1000, 77, 9, {**held, "line": 9})


def test_what_has_ended_is_not_interrupted(tmp_path: Path) -> None:
    assert read_journal(written(tmp_path, (5, {}), ended=True)) is None
    assert read_journal(written(tmp_path)) is None  # nothing was carried out yet
    assert read_journal(tmp_path / "none") is None


def test_a_new_job_makes_the_old_one_forgotten(tmp_path: Path) -> None:
    written(tmp_path, (5, {}))
    found = read_journal(written(tmp_path, (2, {})))
    assert found is not None
    assert found.line == 2


def test_one_that_goes_on_is_interrupted_where_it_was_until_it_is_there(tmp_path: Path) -> None:
    found = Interrupted("part.gcode", 1000, 77, 9, {"z": None, "heaters": {"extruder": 210.0}, "line": 9})
    journal = Journal(tmp_path / NAME, pytest.fail)
    journal.go_on(found)
    journal.close(None)
    assert read_journal(tmp_path / NAME) == found
    journal = Journal(tmp_path / NAME, pytest.fail)
    journal.go_on(found)
    journal.note(10, {})
    journal.close(None)
    assert read_journal(tmp_path / NAME) == Interrupted("part.gcode", 1000, 77, 10, {"line": 10})


def test_wherever_it_is_cut_off_it_tells_an_earlier_line_or_none(tmp_path: Path) -> None:
    path = written(tmp_path, (5, {"x": "é"}), (9, {}), (13, {}), ended=True)
    data = path.read_bytes()
    lines = set()
    for length in range(len(data)):
        path.write_bytes(data[:length])
        found = read_journal(path)
        lines.add(None if found is None else found.line)
    assert lines == {None, 5, 9, 13}


@pytest.mark.parametrize(
    "text", ["", "nonsense", "[1]\n{}", '{"journal":2,"file":"a","size":1,"modified_ns":1}\n{"line":3}',
             '{"journal":1,"file":"a"}\n{"line":3}', '{"line":3}',
             '{"journal":1,"file":"a","size":"x","modified_ns":1}\n{"line":3}',
             '{"journal":1,"file":"a","size":1,"modified_ns":1}\n{"line":"x"}',
             '{"journal":1,"file":"a","size":1,"modified_ns":1,"goes_on":3}', "[" * 100_000,
             *(f'{{"journal":1,"file":"a","size":{size},"modified_ns":1}}\n{{"line":3}}'
               for size in ("Infinity", "NaN", "true", "1.5", "-1", "1" * 30)),
             '{"journal":1,"file":["a"],"size":1,"modified_ns":1}\n{"line":3}',
             *(f'{{"journal":1,"file":"a","size":1,"modified_ns":1}}\n{{"line":3,"{name}":{value}}}'
               for name, value in (("speed_factor", '"x"'), ("speed_factor", "Infinity"), ("offset", "[1]"),
                                   ("offset", '["x",0,0,0]'), ("z", "[1,NaN]"), ("heaters", '{"bed":"60"}'),
                                   ("heaters", '{"bed":Infinity}'), ("fans", "[1]"), ("excluded", "[1]"),
                                   ("heaters", f'{{"bed":{"9" * 1000}}}'), ("speed_factor", "9" * 1000),
                                   ("offset", f"[{'9' * 1000},0,0,0]"), ("bed_mm", "NaN"),
                                   ("mesh", f'{{"heights":[[{"9" * 1000}]]}}')))],
)  # fmt: skip
def test_what_is_no_journal_tells_nothing(tmp_path: Path, text: str) -> None:
    path = tmp_path / NAME
    path.write_text(text, encoding="utf-8")
    assert read_journal(path) is None


def make_fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def wait_for_line(path: Path, line: int) -> None:
    """Return when the journal's thread has written LINE."""
    while (found := read_journal(path)) is None or found.line != line:
        pass


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    "spoil",
    [
        Path.unlink,
        lambda path: os.truncate(path, 0),
        lambda path: os.truncate(path, path.stat().st_size - 3),
        lambda path: path.write_text("nonsense"),
        make_fifo,
    ],
    ids=["removed", "emptied", "cut", "overwritten", "fifo"],
)
def test_what_is_spoiled_while_printing_is_written_again(
    tmp_path: Path, spoil: Callable[[Path], object]
) -> None:
    """The entries that followed had no head: no job was offered after a crash."""
    failures: list[str] = []
    journal = Journal(tmp_path / NAME, failures.append)
    journal.begin("part.gcode", 1000, 77)
    journal.note(5, {})
    wait_for_line(tmp_path / NAME, 5)
    spoil(tmp_path / NAME)
    journal.note(9, {"speed_factor": 2.0})
    journal.note(13, {"speed_factor": 2.0})
    journal.close(None)
    assert not failures
    assert read_journal(tmp_path / NAME) == Interrupted(
        "part.gcode", 1000, 77, 13, {"speed_factor": 2.0, "line": 13}
    )


def test_it_stays_small(tmp_path: Path) -> None:
    long = {"text": "x" * (FILE_BYTES_MAX // 10)}
    path = written(tmp_path, *((n, long) for n in range(1, 40)))
    assert path.stat().st_size <= FILE_BYTES_MAX
    assert json.loads(path.read_bytes().split(b"\n")[0])["file"] == "part.gcode"
    found = read_journal(path)
    assert found is not None
    assert found.line == 39


def test_a_disk_that_cannot_be_written_is_told_once(tmp_path: Path) -> None:
    told: list[str] = []
    journal = Journal(tmp_path / "none" / NAME, told.append)
    journal.begin("part.gcode", 1, 1)
    journal.note(1, {})
    journal.note(2, {})
    journal.close(None)
    assert len(told) == 1
    assert "no such file" in told[0]


def test_new_heights_are_on_the_disk_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a power cut the disk had an old height, on which a job that goes on relied."""
    path, synced = tmp_path / NAME, []

    def fsync(fd: int) -> None:
        if stat.S_ISREG(os.fstat(fd).st_mode) and (found := read_journal(path)) is not None:
            synced.append((found.line, found.held["z"]))

    monkeypatch.setattr(os, "fsync", fsync)
    journal = Journal(path, pytest.fail, clock_s=lambda: 0.0)
    journal.begin("part.gcode", 1000, 77)
    for line, z in ((1, [0.2, 0.2]), (2, [0.2, 0.2]), (3, [0.2, 0.6]), (4, [0.2, 0.6]), (5, [0.4, 0.4])):
        journal.note(line, {"z": z})
    journal.close(None)
    assert synced == [(1, [0.2, 0.2]), (3, [0.2, 0.6]), (5, [0.4, 0.4]), (5, [0.4, 0.4])]

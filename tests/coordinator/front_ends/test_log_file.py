"""The log file: turns of bounded size, bounded memory, one sentence when it cannot be written."""

import threading
from pathlib import Path

from coordinator.front_ends.log_file import FILE_BYTES_MAX, KEPT, LogFile
from coordinator.front_ends.writing_thread import LINE_CHARS_MAX, WAITING_MAX

BLOCK = "\n".join("x" * (LINE_CHARS_MAX - 1) for _ in range(FILE_BYTES_MAX // LINE_CHARS_MAX // 2 + 1))


def test_files_take_turns_and_old_ones_go(tmp_path: Path) -> None:
    path, failures = tmp_path / "canductor.log", list[str]()
    older = [tmp_path / f"{path.name}.{number}" for number in range(1, KEPT + 1)]
    for number, file in enumerate(older, 1):
        file.write_text(f"old {number}\n", encoding="ascii")
    for turn in range(2):  # each writes more than half a file; the second finds what an earlier service left
        log = LogFile(path, failures.append)
        log.add(lambda turn=turn: f"turn {turn}\n{BLOCK}")  # type: ignore[misc]
        log.close(None)
    assert failures == []
    assert sorted(tmp_path.iterdir()) == [path, *older]
    begins = []
    for file in (path, *older):
        assert file.stat().st_size <= FILE_BYTES_MAX
        with file.open(encoding="ascii") as opened:
            begins.append(opened.readline().rstrip())
    assert begins == ["turn 1", "turn 0", *(f"old {number}" for number in range(1, KEPT))]


def test_what_the_disk_has_no_time_for_is_counted(tmp_path: Path) -> None:
    path, slow, waits = tmp_path / "canductor.log", threading.Event(), threading.Event()

    def first() -> str:
        waits.set()
        slow.wait()
        return "first"

    log = LogFile(path, lambda _: None)
    log.add(first)
    waits.wait()
    for number in range(WAITING_MAX + 7):
        log.add(lambda number=number: f"line {number}\x1b[31m")  # type: ignore[misc]
    slow.set()
    log.close(None)
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[0] == "first"
    assert "7 entries were left out here: the disk is slow" in lines
    assert [line for line in lines if line.startswith("line")] == [
        f"line {number}?[31m" for number in range(WAITING_MAX)
    ]


def test_a_file_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    failures = list[str]()
    log = LogFile(tmp_path / "none" / "canductor.log", failures.append)
    for _ in range(3):
        log.add(lambda: "nothing")
    log.close(None)
    assert len(failures) == 1
    assert failures[0].endswith("none/canductor.log cannot be written: no such file or directory")

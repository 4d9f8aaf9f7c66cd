"""Files that threads write, on a disk that answers when the test lets it."""

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from coordinator.support import file_writer
from coordinator.support.atomic_file import replace_content
from coordinator.support.file_writer import FileWriter

PATIENCE_S = 60.0


class Disk:
    """Takes nothing until ``answers`` is set; ``asked`` is released for each write."""

    def __init__(self) -> None:
        self.asked = threading.Semaphore(0)
        self.answers = threading.Event()
        self.written: list[bytes] = []

    def write(self, path: Path, data: bytes) -> None:
        self.asked.release()
        assert self.answers.wait(PATIENCE_S)
        self.written.append(data)
        replace_content(path, data)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[Disk]:
    disk = Disk()
    monkeypatch.setattr(file_writer, "replace_content", disk.write)
    yield disk
    disk.answers.set()


def never(error: OSError) -> None:
    raise AssertionError(error)


def test_what_a_slow_disk_has_not_yet_is_known(tmp_path: Path, disk: Disk) -> None:
    files, path = FileWriter(), tmp_path / "file"
    path.write_bytes(b"0")
    assert files.wait(0.0)
    files.write(path, b"1", never)
    assert disk.asked.acquire(timeout=PATIENCE_S)
    for data in (b"2", b"3"):
        files.write(path, data, never)
        assert files.unwritten(path) == data
    assert not files.wait(0.0)
    assert path.read_bytes() == b"0"
    disk.answers.set()
    assert files.wait(PATIENCE_S)
    assert disk.written == [b"1", b"3"], "of those that came meanwhile, the last"
    assert files.unwritten(path) is None
    assert path.read_bytes() == b"3"
    files.write(path, b"4", never)
    assert files.wait(PATIENCE_S)
    assert path.read_bytes() == b"4"


def test_one_file_does_not_wait_for_another(tmp_path: Path, disk: Disk) -> None:
    files = FileWriter()
    for name in ("a", "b"):
        files.write(tmp_path / name, name.encode(), never)
    for _ in range(2):
        assert disk.asked.acquire(timeout=PATIENCE_S)
    disk.answers.set()
    assert files.wait(PATIENCE_S)
    assert [(tmp_path / name).read_text() for name in ("a", "b")] == ["a", "b"]


def test_what_cannot_be_written_is_reported_and_waits_no_longer(tmp_path: Path) -> None:
    files, path = FileWriter(), tmp_path / "missing" / "file"
    errors: list[OSError] = []
    files.write(path, b"1", errors.append)
    assert files.wait(PATIENCE_S)
    assert files.unwritten(path) is None
    (error,) = errors
    assert isinstance(error, FileNotFoundError)

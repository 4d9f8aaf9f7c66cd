"""Files are written whole or not at all."""

import os
import stat
from pathlib import Path

import pytest

from coordinator.support.atomic_file import atomic_write


def test_a_new_file_is_the_users_alone_and_another_ones_mode_can_be_kept(tmp_path: Path) -> None:
    path, like = tmp_path / "kept", tmp_path / "like"
    atomic_write(path, b"first")
    assert (path.read_bytes(), stat.S_IMODE(path.stat().st_mode)) == (b"first", 0o600)
    like.touch()
    like.chmod(0o640)
    atomic_write(path, b"second", like=like.stat())
    assert (path.read_bytes(), stat.S_IMODE(path.stat().st_mode)) == (b"second", 0o640)


@pytest.mark.parametrize("step", ["fsync", "fchmod"])
def test_what_cannot_be_written_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    path = tmp_path / "kept"
    atomic_write(path, b"first")

    def fail(*_: int) -> None:
        raise OSError(28, "no space left")

    monkeypatch.setattr(os, step, fail)
    with pytest.raises(OSError, match="no space"):
        atomic_write(path, b"second", like=path.stat())
    assert path.read_bytes() == b"first"
    assert [entry.name for entry in tmp_path.iterdir()] == ["kept"]


def test_the_content_is_on_the_disk_before_its_name_and_the_name_at_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, synced = tmp_path / "kept", []

    def note(handle: int) -> None:
        synced.append((stat.S_ISDIR(os.fstat(handle).st_mode), path.exists()))

    monkeypatch.setattr(os, "fsync", note)
    atomic_write(path, b"first")
    assert synced == [(False, False), (True, True)]

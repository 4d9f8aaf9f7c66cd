"""Files are written whole or not at all."""

import os
import stat
from pathlib import Path

import pytest

from coordinator.support.atomic_file import atomic_write, replace_content


def test_a_new_file_is_the_users_alone_and_another_ones_mode_can_be_kept(tmp_path: Path) -> None:
    path, like = tmp_path / "kept", tmp_path / "like"
    atomic_write(path, b"first")
    assert (path.read_bytes(), stat.S_IMODE(path.stat().st_mode)) == (b"first", 0o600)
    like.touch()
    like.chmod(0o640)
    atomic_write(path, b"second", like=like.stat())
    assert (path.read_bytes(), stat.S_IMODE(path.stat().st_mode)) == (b"second", 0o640)


def test_a_file_that_gets_other_content_keeps_its_mode_and_the_links_to_it(tmp_path: Path) -> None:
    real, link, nowhere = tmp_path / "real", tmp_path / "link", tmp_path / "nowhere"
    real.write_bytes(b"first")
    real.chmod(0o640)
    link.symlink_to("real")
    replace_content(link, b"second")
    assert (real.read_bytes(), stat.S_IMODE(real.stat().st_mode)) == (b"second", 0o640)
    nowhere.symlink_to("new")
    replace_content(nowhere, b"third")
    assert (link.is_symlink(), nowhere.is_symlink()) == (True, True)
    new = tmp_path / "new"
    assert (new.read_bytes(), stat.S_IMODE(new.stat().st_mode)) == (b"third", 0o600)


def test_a_write_protected_file_is_not_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "kept"
    path.write_bytes(b"first")
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write everything
    with pytest.raises(PermissionError, match="it is write-protected"):
        replace_content(path, b"second")
    assert path.read_bytes() == b"first"


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

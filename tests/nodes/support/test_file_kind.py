"""What is at a path, and what is said where that cannot be found out."""

import os
from pathlib import Path

import pytest

from nodes.support.errors import CanductorError
from nodes.support.file_kind import exists, is_folder, is_regular

LOOKS = (exists, is_folder, is_regular)


def test_what_is_there(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to("file")
    (tmp_path / "nowhere").symlink_to("none")
    os.mkfifo(tmp_path / "fifo")
    found = {
        name: tuple(look(tmp_path / name) for look in LOOKS)
        for name in (".", "file", "link", "fifo", "nowhere", "none", "file/none")
    }
    assert found == {
        ".": (True, True, False),
        "file": (True, False, True),
        "link": (True, False, True),
        "fifo": (True, False, False),
        "nowhere": (False, False, False),
        "none": (False, False, False),
        "file/none": (False, False, False),
    }


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("x" * 256, "file name too long"),
        ("loop", "too many levels of symbolic links"),
        ("a\0b", "no file can have this name"),
    ],
)
def test_what_cannot_be_looked_at(tmp_path: Path, name: str, reason: str) -> None:
    (tmp_path / "loop").symlink_to("loop")
    for look in LOOKS:
        with pytest.raises(CanductorError) as refused:
            look(tmp_path / name)
        shown = str(tmp_path / name).replace("\0", "?")
        assert str(refused.value) == f"'{shown}' cannot be looked at: {reason}"


def test_another_users_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    def stat(*_: object, **__: object) -> os.stat_result:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.stat", stat)
    with pytest.raises(CanductorError, match="'/home/other/x' cannot be looked at: permission denied"):
        exists("/home/other/x")

import os
from io import BytesIO
from pathlib import Path

import pytest

from coordinator.dnc.files import (
    CHECKED_MAX,
    FileRefused,
    Folder,
    check_lines,
    check_name,
    read_lines,
    stored_name,
)
from coordinator.dnc.protocol.blocks import BadText
from coordinator.dnc.tables import check_table
from nodes.support.errors import CanductorError


def names(path: Path) -> list[str]:
    return sorted(p.name for p in path.iterdir())


@pytest.mark.parametrize(
    "name",
    [
        "", ".", "..", "../x", "a/b",
        "/etc/passwd", "a\\b", ".hidden", "-rf", "a\0b", "a\nb", "NUL", "nul.nc",
        "CON", "com1.h", "LPT9", "a:b", "a;b", "a*", "a?", "x.", "x ", " x", "ä", "x" * 101, "a|b", "\x7f",
    ],
)  # fmt: skip
def test_bad_names(name: str, tmp_path: Path) -> None:
    with pytest.raises(FileRefused, match="is not a valid file name"):
        check_name(name)
    folder = Folder(tmp_path)
    with pytest.raises(FileRefused):
        folder.take("D", name)
    assert names(tmp_path) == []


def test_names_get_a_suffix_by_code() -> None:
    assert stored_name("H", "15") == "15.h"
    assert stored_name("D", "PART") == "PART.nc"
    assert stored_name("S", "AXIS_X") == "AXIS_X.comp"
    assert stored_name("S", "AXIS.CSV") == "AXIS.CSV"
    assert stored_name("Q", "X") == "X"


def test_a_file_is_there_when_it_is_whole(tmp_path: Path) -> None:
    folder = Folder(tmp_path)
    incoming = folder.take("D", "A")
    incoming.write(b"X1")
    assert all(name.startswith(".") for name in names(tmp_path))
    assert folder.files() == []
    incoming.write(b"")
    incoming.keep()
    assert (tmp_path / "A.nc").read_bytes() == b"X1\n\n"
    assert names(tmp_path) == ["A.nc"]
    incoming.drop()
    assert names(tmp_path) == ["A.nc"]


def test_a_dropped_file_leaves_nothing(tmp_path: Path) -> None:
    incoming = Folder(tmp_path, newline=b"\r\n").take("D", "A")
    incoming.write(b"X1")
    incoming.drop()
    assert names(tmp_path) == []


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / "A.nc").write_text("old")
    with pytest.raises(FileRefused, match="already; use another name, or give --overwrite") as refused:
        Folder(tmp_path).take("D", "A")
    assert refused.value.text == "FILE EXISTS"
    overwriting = Folder(tmp_path, overwrite=True).take("D", "A")
    assert (tmp_path / "A.nc").read_text() == "old"
    overwriting.keep()
    assert (tmp_path / "A.nc").read_text() == ""


def test_a_file_that_came_meanwhile_is_not_overwritten(tmp_path: Path) -> None:
    incoming = Folder(tmp_path).take("D", "A")
    (tmp_path / "A.nc").write_text("theirs")
    with pytest.raises(FileRefused, match="in the meantime"):
        incoming.keep()
    assert (tmp_path / "A.nc").read_text() == "theirs"
    assert names(tmp_path) == ["A.nc"]


def test_without_hard_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    first, second = Folder(tmp_path).take("D", "A"), Folder(tmp_path).take("D", "A")
    first.write(b"X1")
    first.keep()
    with pytest.raises(FileRefused):
        second.keep()
    assert (tmp_path / "A.nc").read_bytes() == b"X1\n"
    assert names(tmp_path) == ["A.nc"]


def test_links_are_not_followed(tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.write_text("secret")
    inside = tmp_path / "inside"
    inside.mkdir()
    (inside / "A.nc").symlink_to(outside)
    (inside / "B.nc").symlink_to(tmp_path / "new")
    (inside / "D.nc").mkdir()
    folder = Folder(inside, overwrite=True)
    for name in "ABD":
        with pytest.raises(FileRefused):
            folder.open("D", name)
        with pytest.raises(FileRefused, match="exists and is not a file"):
            folder.take("D", name)
    assert folder.files() == []
    assert outside.read_text() == "secret"


def test_files_are_found_whatever_their_case(tmp_path: Path) -> None:
    (tmp_path / "Part.nc").write_bytes(b"X1\n")
    (tmp_path / "15.H").write_bytes(b"")
    (tmp_path / ".hidden").write_bytes(b"")
    folder = Folder(tmp_path)
    for code, name in (("D", "PART"), ("D", "part.NC"), ("H", "Part.nc")):
        found, content = folder.open(code, name)
        with content:
            assert (found, content.read()) == ("Part.nc", b"X1\n")
    assert [(e.name, e.code) for e in folder.files()] == [("15.H", "H"), ("Part.nc", "D")]
    with pytest.raises(FileRefused, match="there is no file"):
        folder.open("D", "../Part.nc")


def test_tables_are_checked_before_they_are_kept(tmp_path: Path) -> None:
    seen: list[tuple[bytes, str]] = []

    def check(content: bytes, name: str) -> None:
        seen.append((content, name))
        if b"bad" in content:
            raise CanductorError("row 1 is no number")

    folder = Folder(tmp_path, check=check)
    for name, line in (("BAD", b"bad"), ("GOOD", b"0 0 0")):
        incoming = folder.take("S", name)
        incoming.write(line)
        if line == b"bad":
            with pytest.raises(CanductorError, match="row 1 is no number"):
                incoming.keep()
        else:
            incoming.keep()
    program = folder.take("D", "BAD")
    program.write(b"bad")
    program.keep()
    assert seen == [(b"bad\n", "BAD.comp"), (b"0 0 0\n", "GOOD.comp")]
    assert names(tmp_path) == ["BAD.nc", "GOOD.comp"]
    huge = folder.take("S", "HUGE")
    with pytest.raises(FileRefused, match="is longer than"):
        huge.write(b"0" * CHECKED_MAX)
    huge.drop()


def test_a_table_is_validated_like_an_imported_one(tmp_path: Path) -> None:
    folder = Folder(tmp_path, check=check_table)
    for name, rows in (("GOOD", (b"0 0 0", b"100 100.01 100.02")), ("BAD", (b"100 100 100", b"0 0 0"))):
        incoming = folder.take("S", name)
        for row in rows:
            incoming.write(row)
        if name == "GOOD":
            incoming.keep()
        else:
            with pytest.raises(CanductorError, match=r"BAD\.comp"):
                incoming.keep()
    assert names(tmp_path) == ["GOOD.comp"]


def test_a_full_disk_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    incoming = Folder(tmp_path).take("D", "A")
    incoming.write(b"X1")

    def fail(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(FileRefused, match=r"A.nc cannot be written: no space left on device"):
        incoming.keep()
    assert names(tmp_path) == []


def test_no_folder(tmp_path: Path) -> None:
    with pytest.raises(CanductorError, match="cannot be opened: no such file or directory; create it"):
        Folder(tmp_path / "none")


def test_lines() -> None:
    assert list(read_lines(BytesIO(b"A\r\n\nB\nC"), 10)) == [b"A", b"", b"B", b"C"]
    assert list(read_lines(BytesIO(b"1234567890\r\n"), 10)) == [b"1234567890"]
    with pytest.raises(BadText, match="line 2 is longer than 10"):
        list(read_lines(BytesIO(b"\n12345678901\n"), 10))
    assert check_lines(BytesIO(b"A\nB\n"), "f", 10, 7) == 2
    for content, sentence in (
        (b"A\tB", "09 hex, which no block"),
        (b"\xc4", "7 bits"),
        (b"A\rB\n", "0D hex"),
    ):
        with pytest.raises(BadText, match=sentence):
            check_lines(BytesIO(content), "f", 10, 7)

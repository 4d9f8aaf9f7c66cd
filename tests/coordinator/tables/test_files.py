"""Files of tables: both types of COMP_FILE, CSV, and everything that is neither."""

import contextlib
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.tables.axis_table import AxisTable, TableError, Unit
from coordinator.tables.files import ACTUAL, TRIM, read_table


def write(folder: Path, text: str | bytes, name: str = "x.comp") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_type_1_gives_what_is_to_be_added(tmp_path: Path) -> None:
    path = write(tmp_path, "# nominal forward reverse\n0 0.001 -0.002\n\n 10\t.002 -1e-3 ; end\n")
    table = read_table(path, axis="x", comp_type=TRIM)
    assert table == AxisTable(axis="x", positions=(0, 10), forward=(0.001, 0.002), reverse=(-0.002, -0.001))


def test_type_0_gives_where_the_axis_really_was(tmp_path: Path) -> None:
    table = read_table(write(tmp_path, "0 0 0.01\n10 10.02 9.99\n"), axis="x", comp_type=ACTUAL)
    assert table.forward == pytest.approx((0, -0.02))
    assert table.reverse == pytest.approx((-0.01, 0.01))


def test_units(tmp_path: Path) -> None:
    inches = read_table(write(tmp_path, "0 0 0\n1 1.001 1\n"), axis="x", unit="inch")
    assert inches.positions == (0, 25.4)
    assert inches.forward == pytest.approx((0, -0.0254))
    angle = read_table(write(tmp_path, "0 0 0\n5 .05 -.05\n"), axis="a", unit="arcmin", comp_type=TRIM)
    assert angle.unit is Unit.DEG
    assert angle.positions == pytest.approx((0, 5 / 60))


def test_csv_says_its_units_itself(tmp_path: Path) -> None:
    text = "\ufeffremark; Position_MM ;forward_um;reverse_nm\n# first\na;0;1;2000\nb;10,;3;4\n"
    with pytest.raises(TableError, match=r"x\.csv:4: '10,' is no number"):
        read_table(write(tmp_path, text, "x.csv"), axis="x")
    table = read_table(write(tmp_path, text.replace("10,", "10"), "x.csv"), axis="x")
    assert table.positions == (0, 10)
    assert table.forward == pytest.approx((0.001, 0.003))
    assert table.reverse == pytest.approx((0.002, 4e-6))


def test_csv_without_reverse_is_the_same_both_ways(tmp_path: Path) -> None:
    table = read_table(write(tmp_path, "position_mm,forward_um\n0,1\n5,2\n", "x.csv"), axis="x")
    assert table.symmetric


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("0 0\n1 1 1\n", ":1: 2 values, must be three"),
        ("0 0 0\n1 x 1\n", ":2: 'x' is no number"),
        ("0 0 0\n1 nan 1\n", ":2: 'nan' is no number"),
        ("0 0 0\n1 1e999 1\n", ":2: '1e999' is no number"),
        ("0 0 0\n1_0 1 1\n", ":2: '1_0' is no number"),
        ("0 0 0\n\n# a\n-1 -1 -1\n", ":4: the position -1 mm follows 0 mm"),
        ("0 0 0\n1 1.5 1\n", r":2: the forward correction changes by -0\.5 mm per mm"),
        ("0 9 0\n1 1 1\n", ":1: a correction of -9 mm"),
        ("", ": 0 points; a table has 2 to 10000"),
        ("0 0 0\n", ": 1 points; a table has 2 to 10000"),
        ("\x1b[31m 0 0\n", r":1: '\?\[31m' is no number"),
    ],
)
def test_what_is_wrong_is_told_with_its_line(tmp_path: Path, text: str, problem: str) -> None:
    with pytest.raises(TableError, match=rf"x\.comp{problem}"):
        read_table(write(tmp_path, text), axis="x")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "is empty"),
        ("0,1,2\n", ":1: the first line must name the columns"),
        ("position_mm,forward_ell\n", ":1: the column 'forward' must be there once, with a unit of mm, um"),
        ("position_mm,forward_mm,forward_um\n", ":1: the column 'forward' must be there once"),
        ("position_mm,forward_arcsec\n", ":1: lengths and angles in one table"),
        ("position_mm,forward_um\n0,1\n3\n", ":3: 1 values, fewer than its first line names"),
    ],
)
def test_what_is_wrong_with_csv(tmp_path: Path, text: str, problem: str) -> None:
    with pytest.raises(
        TableError, match=rf"x\.csv:? ?{problem}" if problem[0] != ":" else rf"x\.csv{problem}"
    ):
        read_table(write(tmp_path, text, "x.csv"), axis="x")


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(TableError, match="cannot be read: No such file"):
        read_table(tmp_path / "none", axis="x")
    with pytest.raises(TableError, match="is no text file"):
        read_table(write(tmp_path, b"\xff\xfe\x00"), axis="x")
    with pytest.raises(TableError, match="more than 4000000 bytes"):
        read_table(write(tmp_path, b"0 0 0\n" * 700_000), axis="x")
    with pytest.raises(TableError, match="units are mm, um, nm, inch, deg"):
        read_table(write(tmp_path, ""), axis="x", unit="ell")


def test_what_is_no_regular_file_is_not_read(tmp_path: Path) -> None:
    """A device may never end, a FIFO never begin."""
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    for path in (tmp_path, Path("/dev/null"), Path("/dev/zero"), fifo):
        with pytest.raises(TableError, match=f"^{path} is not a regular file; give a COMP_FILE or CSV$"):
            read_table(path, axis="x")


def test_line_ends_of_all_kinds(tmp_path: Path) -> None:
    tables = [
        read_table(write(tmp_path, end.join(("0 0 0", "1 1 1"))), axis="x") for end in ["\n", "\r\n", "\r"]
    ]
    assert tables[0] == tables[1] == tables[2]


texts = st.text('0123456789 .-+e\n,;_positnfrwardm#"', max_size=200)
heads = st.sampled_from(["", "position_mm,forward_um,reverse_nm\n", "position_deg;forward_arcsec\n"])


@given(st.one_of(st.binary(max_size=200), texts), heads, st.booleans())
def test_any_file_is_a_table_or_an_error(
    tmp_path_factory: pytest.TempPathFactory, content: bytes | str, head: str, is_csv: bool
) -> None:
    path = tmp_path_factory.getbasetemp() / "any"
    path.write_bytes(head.encode() + (content if isinstance(content, bytes) else content.encode()))
    with contextlib.suppress(TableError):
        assert read_table(path, axis="x", is_csv=is_csv).axis == "x"


def test_a_field_that_is_too_long_for_csv(tmp_path: Path) -> None:
    path = write(tmp_path, "position_mm,forward_um\n0," + "1" * 200_000 + "\n", "x.csv")
    with pytest.raises(TableError, match=r"x\.csv:2: "):
        read_table(path, axis="x")

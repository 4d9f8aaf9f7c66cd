"""Programs with numbered lines: what was doubled or lost shows, and sound ones pass."""

from pathlib import Path

import pytest

from coordinator.dnc.files import FileRefused, Folder
from coordinator.dnc.protocol.blocks import Header
from coordinator.dnc.protocol.numbers import LineNumbers, numbered

DIALOG = (
    "0 BEGIN PGM 15 MM",
    "1 BLK FORM 0.1 Z X+0 Y+0 Z-40",
    "2 BLK FORM 0.2 X+100 Y+100 Z+0",
    "3 CYCL DEF 200 DRILLING ~",
    "    Q200=+2 ;SET-UP CLEARANCE ~",
    "    Q201=-20 ;DEPTH",
    "4 ; a remark",
    "5 L X+50 Y+50 R0 FMAX M99",
    "6 END PGM 15 MM",
)
ISO = ("%15 G71 *", "N10 G28", "N20 G1 X1", "N30 G1 X1", "G1 X1", "G1 X1", "", "", "N40 M30")


def look(lines: tuple[str, ...] | list[str], *, even: bool = False) -> None:
    numbers = LineNumbers("PART", even=even)
    for line in lines:
        numbers.check(line.encode())
    numbers.end()


@pytest.mark.parametrize("even", [False, True])
def test_sound_programs_pass(even: bool) -> None:
    look(DIALOG, even=even)
    look(ISO, even=even)
    look([], even=even)
    look(["0 1.5", "1 2.5", "5 2.5", "5 2.5"], even=even)  # a table


def test_a_dialog_program_shows_every_line_that_is_doubled_or_lost() -> None:
    """Those that have a number."""
    for at, line in enumerate(DIALOG):
        if line.startswith(" "):
            continue
        with pytest.raises(FileRefused, match="received twice or lost"):
            look([*DIALOG[: at + 1], *DIALOG[at:]])
        if at:
            with pytest.raises(FileRefused, match=r"received twice or lost|no END PGM"):
                look([*DIALOG[:at], *DIALOG[at + 1 :]])
    for end in range(1, len(DIALOG)):
        with pytest.raises(FileRefused, match="PART has no END PGM: its end is missing"):
            look(DIALOG[:end])


def test_an_iso_program_shows_a_numbered_line_that_is_doubled() -> None:
    with pytest.raises(FileRefused, match=r"line 4 of PART was received twice \(N20\)"):
        look([*ISO[:3], *ISO[2:]])
    look([*ISO[:2], *ISO[3:]])  # anybody may have taken a line out
    with pytest.raises(FileRefused, match="line 4 of PART has number 50, after 30"):
        look(["N10", "N20", "N30", "N50"], even=True)


@pytest.mark.parametrize("numbers", [(10, 20, 40), (10, 20, 20), (10, 20, 10), (5, 10, 20, 30)])
def test_even_numbers(numbers: tuple[int, ...]) -> None:
    lines = [f"N{number} G1 X{at}" for at, number in enumerate(numbers)]
    look(lines)
    with pytest.raises(FileRefused, match="has number"):
        look(lines, even=True)


def test_a_file_of_them_is_not_kept(tmp_path: Path) -> None:
    folder = Folder(tmp_path)
    sink = numbered(lambda header: folder.take(header.code, header.name), even=False)(Header("H", "15", "A"))
    for line in DIALOG[:4]:
        sink.write(line.encode())
    with pytest.raises(FileRefused, match=r"15\.h has no END PGM"):
        sink.keep()
    sink.drop()
    assert list(tmp_path.iterdir()) == []

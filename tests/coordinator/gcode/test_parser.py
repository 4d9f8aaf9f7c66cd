"""Lines that the hot path leaves to Python: words, comments, checksums."""

import pytest

from coordinator.gcode.parser import Command, WordError, parse


def read(line: str) -> Command:
    command = parse(line.encode())
    assert command is not None
    return command


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("M117 2*x", " 2*x"),
        ("M118 a*b (c)", " a*b (c)"),
        ("M23 a(1)*b.gcode", " a(1)*b.gcode"),
        ("M104 S20 (a*b)", "S20"),
        ("N3 M104 S20 *116", "S20"),
    ],
)
def test_a_star_may_stand_in_a_text(line: str, text: str) -> None:
    """Failed before: everything behind a star was a checksum, and parentheses in a file's name a comment."""
    assert read(line).text == text


@pytest.mark.parametrize("line", ["N3 M104 S20*9x", "N3 M104 S20*", "M104 S20*7", "M117 5*3"])
def test_a_wrong_checksum_is_refused(line: str) -> None:
    with pytest.raises(WordError, match="the checksum is"):
        read(line)


def test_stars_and_blanks_are_read_once() -> None:
    """Failed before: a line of stars took 0.16 s, a thousand of them minutes."""
    for number in range(1000):
        for filling in ("*", "* ", "*" + " " * 100):
            assert read(f"M118 {number} {filling * (4000 // len(filling))} y z").name == "M118"


@pytest.mark.parametrize(
    ("line", "parameters"),
    [
        ('SAY MSG="a;b" N=1 ; more', {"MSG": "a;b", "N": "1"}),
        ("SAY MSG='a;b';N=2", {"MSG": "a;b"}),
        ("SAY MSG=don't ; it's", {"MSG": "don't"}),
        ('SAY MSG="a ; b', {"MSG": "a"}),
    ],
)
def test_a_semicolon_in_quotes_begins_no_comment(line: str, parameters: dict[str, str]) -> None:
    """Failed before: SDCARD_PRINT_FILE FILENAME="a.gcode;b.gcode" printed a.gcode."""
    assert read(line).parameters() == parameters


@pytest.mark.parametrize("text", ["S1e999", "S0x5", "T0 S1d3", "S1e9", "S.5x"])
def test_letters_in_a_number_are_no_words(text: str) -> None:
    """Failed before: ``M104 S1e999`` set 1 °C, and said that E means nothing."""
    with pytest.raises(WordError, match=r"S of M104 is '[^']+', which is not a number"):
        read(f"M104 {text}").only_words("ST")


def test_words_may_follow_each_other_without_blanks() -> None:
    assert read("G92X1E2").only_words("XYZE") == {"X": "1", "E": "2"}
    assert read("M104S20T0 P1").only_words("ST") == {"S": "20", "T": "0"}

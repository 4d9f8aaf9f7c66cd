"""Lines of a client's text: ends of lines are those of files, and nothing else."""

import pytest

from coordinator.gcode.script_lines import script_lines


@pytest.mark.parametrize(
    ("script", "lines"),
    [
        ("", []),
        ("\n", [""]),
        ("G28", ["G28"]),
        ("G28\n", ["G28"]),
        ("G28\r\n\r\nG1 X1\rM400", ["G28", "", "G1 X1", "M400"]),
    ],
)
def test_lines_end_as_in_files(script: str, lines: list[str]) -> None:
    assert script_lines(script) == lines


@pytest.mark.parametrize("mark", ["\x0b", "\x0c", "\x1c", "\x1d", "\x1e", "\x85", "\u2028", "\u2029"])
def test_no_other_character_begins_a_command(mark: str) -> None:
    script = f"M117 hello{mark}M118 injected"
    assert script_lines(script) == [script]

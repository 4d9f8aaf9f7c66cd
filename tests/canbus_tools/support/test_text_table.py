"""Plain tables and paragraphs."""

from canbus_tools.support.text_table import WIDTH, count, paragraph, table


def test_columns_line_up_and_empty_ones_are_left_out() -> None:
    assert table(("id", "none", "what"), [["4", "", "a"], ["200", "", ""]]) == [
        "  id   what",
        "  4    a",
        "  200",
    ]


def test_a_command_in_quotes_stays_in_one_line() -> None:
    command = "'canductor can release 5 -i canductor -c somewhere'"
    lines = paragraph(f"{'word ' * 17}{command} and more")
    assert any(command in line for line in lines)
    assert len(lines) == 2
    assert max(map(len, lines)) <= WIDTH


def test_counts() -> None:
    assert (count(1, "node"), count(2, "node"), count(2, "uuid waits", "uuids wait")) == (
        "1 node",
        "2 nodes",
        "2 uuids wait",
    )

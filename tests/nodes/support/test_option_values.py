"""Options of command lines: converters, sentences with the option's name, dataclasses."""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import pytest

from nodes.support.option_values import (
    Assignments,
    Parser,
    ParserExit,
    UsageError,
    add_command,
    decimal,
    integer,
    options_from,
    parse_assignment,
    parse_hex,
    parse_ratio,
)


@dataclass(frozen=True, kw_only=True)
class Options:
    count: int
    ratio: float = 0.25
    by_node: dict[str, int] = field(default_factory=dict)
    name: str = "none"


def parser() -> Parser:
    made = Parser(prog="tool")
    add = made.add_argument
    add("-n", "--number", dest="count", type=integer(1, 5), default=3, help="how many")
    add("--ratio", type=parse_ratio, default=0.5, help="how much")
    add("--of", dest="by_node", type=partial(parse_assignment, convert=int), action=Assignments)
    add("--id", type=partial(parse_hex, high=0x7FF))
    add("--time", type=decimal(0, 10, "s"))
    return made


def parsed(*words: str) -> Any:
    return parser().parse_args(words)


def test_a_dataclass_takes_the_options_of_its_fields() -> None:
    words = ("-n", "4", "--ratio", "1%", "--of", "a=1", "--of", "b=2", "--id", "0x1f")
    options = options_from(Options, parsed(*words), name="x")
    assert options == Options(count=4, ratio=0.01, by_node={"a": 1, "b": 2}, name="x")
    assert options_from(Options, parsed()) == Options(count=3, ratio=0.5)
    assert parsed("--of", "a=1").by_node == {"a": 1}
    assert parsed().by_node == {}


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("-n 6", "--number is '6', must be a whole number from 1 to 5"),
        ("--number \u0663", "--number is '\u0663', must be a whole number from 1 to 5"),
        ("--ratio nan", "--ratio is 'nan', must be a ratio from 0 to 0.5, or a percentage such as 1%"),
        ("--time inf", "--time is 'inf', must be a number from 0 to 10 s"),
        ("--id 0x800", "--id is '0x800', must be a number from 0 to 0x7ff"),
        ("--of a", "--of takes NAME=VALUE, not 'a'"),
        ("--of a=1 --of a=2", "--of is given twice for 'a'"),
        ("--num 3", "unrecognized arguments: --num 3"),
    ],
)
def test_a_sentence_names_the_option(words: str, sentence: str) -> None:
    with pytest.raises(UsageError) as refused:
        parsed(*words.split())
    assert str(refused.value) == sentence


def test_help_has_the_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ParserExit):
        parsed("--help")
    text = " ".join(capsys.readouterr().out.split())
    assert "how many (default: 3)" in text
    assert "how much (default: 0.5)" in text


def test_an_error_names_its_command() -> None:
    made = Parser(prog="tool")
    commands = made.add_subparsers(required=True)
    add_command(commands, "go", "start it", lambda c: c.add_argument("--far", type=integer()), lambda _: None)
    with pytest.raises(UsageError) as refused:
        made.parse_args(["go", "--far", "x"])
    assert refused.value.command == "tool go"
    with pytest.raises(UsageError) as refused:
        made.parse_args([])
    assert refused.value.command == "tool"

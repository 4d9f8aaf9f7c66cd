"""What is typed at the console: reading it, its values, the answers of commands, completion."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canbus_tools.console.expressions import Quantity
from canbus_tools.console.parser import (
    ConsoleError,
    NodeCommand,
    OwnCommand,
    answer_to,
    complete,
    may_repeat,
    names_wanted,
    read_duration_s,
    read_line,
    read_repeat,
    values_of,
)
from nodes.dictionary.message_format import MessageError
from nodes.virtual.firmware import MAINBOARD, firmware_dictionary

WORDS = firmware_dictionary(MAINBOARD)
NAMES = {"clock": Quantity.clock(2**32 - 1)}


def values(line: str) -> dict[str, int | bytes | str]:
    command = read_line(line)
    assert isinstance(command, NodeCommand)
    return values_of(WORDS, command, NAMES)


def test_lines() -> None:
    assert read_line("  # a comment") is None
    assert read_line("") is None
    assert read_line('a b="x # y" c=1 # so') == NodeCommand("a", {"b": '"x # y"', "c": "1"})
    assert read_line("get_uptime  # a question") == NodeCommand("get_uptime", {})
    assert read_line("get_uptime ") == NodeCommand("get_uptime", {})
    assert read_line('a b=1 + 2  c = max(x, 3) d="x y=2" e=a==b') == NodeCommand(
        "a", {"b": "1 + 2", "c": "max(x, 3)", "d": '"x y=2"', "e": "a==b"}
    )
    assert read_line("/set x 3") == OwnCommand("/set", "x 3")
    assert read_line("/rep 3 x") == OwnCommand("/repeat", "3 x")


@pytest.mark.parametrize("line", ["a 1", "a b=1 b=2", "a b=", "/nothing", "/", "x" * 2001])
def test_lines_that_say_nothing(line: str) -> None:
    with pytest.raises(ConsoleError):
        read_line(line)


@given(st.text(max_size=80))
def test_any_line_is_a_command_or_one_error(line: str) -> None:
    try:
        command = read_line(line)
        if isinstance(command, NodeCommand):
            values_of(WORDS, command, NAMES)
    except (ConsoleError, MessageError) as error:
        assert str(error)  # noqa: PT017


def test_values_by_the_kind_of_their_parameter() -> None:
    step = "queue_step oid=2-2 interval=3*freq/1000 count=10 add=-0x10"
    with pytest.raises(ConsoleError, match=r"interval.*nothing is called 'freq'"):
        values(step)
    assert values("config_digital_out oid=1 pin=PA3 value=0 default_value=0 max_duration=1ms") == {
        "oid": 1,
        "pin": WORDS.enumerations["pin"].values["PA3"],
        "value": 0,
        "default_value": 0,
        "max_duration": round(WORDS.clock_freq_hz / 1000),
    }
    assert values("reset_step_clock oid=0 clock=clock+10") == {"oid": 0, "clock": 9}


def test_faults_say_what_there_is() -> None:
    with pytest.raises(ConsoleError, match="nor is it a pin: ADC_TEMPERATURE, PA0"):
        values("config_digital_out pin=ZZ9")
    with pytest.raises(ConsoleError, match=r"has no parameter 'x'; it is 'get_clock'"):
        values("get_clock x=1")
    with pytest.raises(ConsoleError, match="did you mean get_clock"):
        values("get_clo")


def test_only_what_is_used_is_wanted() -> None:
    command = read_line("config_digital_out oid=n pin=PA3 value=clock+1")
    assert isinstance(command, NodeCommand)
    assert names_wanted(WORDS, command) == {"n", "clock"}


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        ("get_uptime", "uptime"),
        ("get_config", "config"),
        ("get_canbus_id", "canbus_id"),
        ("stepper_get_position", "stepper_position"),
        ("endstop_query_state", "endstop_state"),
        ("identify", "identify_response"),
        ("trsync_trigger", "trsync_state"),
        ("queue_step", None),
        ("emergency_stop", None),
    ],
)
def test_answers(command: str, answer: str | None) -> None:
    assert command in WORDS.commands
    assert answer_to(WORDS, command) == answer


def test_what_acts_is_never_sent_twice() -> None:
    assert may_repeat("get_clock")
    assert may_repeat("endstop_query_state")
    assert not may_repeat("trsync_trigger")
    assert not may_repeat("spi_transfer")


def test_times_and_repeats() -> None:
    assert read_duration_s("50ms") == 0.05
    assert read_duration_s("2*1.5s") == 3
    for text in ("50", "2s+1", "-1s", "2d", "100000s", ""):
        with pytest.raises(Exception, match=r"time|expression"):
            read_duration_s(text)
    assert read_repeat("3 get_clock") == (3, 0.0, "get_clock")
    assert read_repeat("3 10ms queue_step oid=1") == (3, 0.01, "queue_step oid=1")
    assert read_repeat("2 /eval clock") == (2, 0.0, "/eval clock")
    for text in ("", "3", "0x3 get_clock", "3 10ms", "3 /repeat 3 get_clock", "3 /quit"):
        with pytest.raises(ConsoleError):
            read_repeat(text)


def shown(line: str) -> list[str]:
    return [candidate.text for candidate in complete(WORDS, ["clock", "freq", "start"], line)]


def test_completion() -> None:
    assert shown("get_can") == ["get_canbus_id", "get_canbus_status"]
    assert shown("/re") == ["/repeat"]
    assert shown("/repeat 3 50ms get_canbus_i") == ["get_canbus_id"]
    assert shown("/eval 2*fr") == ["freq"]
    assert shown("config_digital_out oid=1 p") == ["pin="]
    assert "oid=" not in shown("config_digital_out oid=1 ")
    assert shown("config_digital_out oid=1 pin=PA1")[:3] == ["PA1", "PA10", "PA11"]
    assert shown("reset_step_clock oid=1 clock=clock+st") == ["start"]
    assert shown("nothing ") == []
    assert shown("config_digital_out oid=1 pin=PA")
    (candidate,) = complete(WORDS, [], "get_canbus_i")
    assert (candidate.replaces, candidate.note) == (12, "")


@given(st.text(max_size=60))
def test_completion_never_fails(line: str) -> None:
    for candidate in complete(WORDS, ["clock"], line):
        assert 0 <= candidate.replaces <= len(line)

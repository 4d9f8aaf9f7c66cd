"""Lines that the program writes itself: nothing in a parameter becomes a command or another parameter."""

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from coordinator.gcode.parser import WordError, command_line, parse
from tests.profiles import examples


@settings(max_examples=examples(60))
@given(name=st.text(max_size=20), celsius=st.floats(-1e6, 1e6))
@example(name="bed TARGET=300", celsius=60.0)
@example(name='bed" TARGET="300', celsius=60.0)
@example(name="bed\nM112", celsius=60.0)
@example(name="bed\rM112", celsius=60.0)
@example(name="bed;M112", celsius=60.0)
@example(name="my bed", celsius=1e-7)
@example(name="", celsius=0.0)
def test_it_is_read_as_it_was_meant_or_refused(name: str, celsius: float) -> None:
    """Failed before: names with blanks broke the line, and a journal could add parameters and commands."""
    try:
        line = command_line("SET_HEATER_TEMPERATURE", HEATER=name, TARGET=celsius)
    except WordError:
        assert not name.isalnum() or not name.isascii()
        return
    assert len(line.splitlines()) == 1
    command = parse(line.encode())
    assert command is not None
    assert command.name == "SET_HEATER_TEMPERATURE"
    found = command.parameters()
    assert found.keys() == {"HEATER", "TARGET"}
    assert found["HEATER"] == name
    assert float(found["TARGET"]) == pytest.approx(celsius, rel=1e-9)

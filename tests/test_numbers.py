"""Numbers from outside: every way in reads the same, and nothing that is no plain finite number."""

import math
from argparse import ArgumentTypeError
from collections.abc import Callable
from typing import Final

import pytest

from coordinator.cli.commands.demo import _ppm
from coordinator.config.options import BadValue, FloatOption, IntOption
from coordinator.gcode.parser import WordError, number
from coordinator.modules.eddy_current.coil_drift import DriftOption
from coordinator.modules.eddy_current.eddy_table import TableOption
from coordinator.modules.homing.endstop_phase import PhaseOption
from coordinator.modules.levelling.delta_calibrate import _numbers
from coordinator.modules.programs.gcode_macro import literal
from nodes.support.numbers import read_decimal, read_int
from nodes.support.option_values import UsageError, parse_float, parse_hex, parse_int, parse_ratio

EDDY: Final = TableOption(name="x", help="")
DRIFT: Final = DriftOption(name="x", help="")
NO_NUMBERS: Final = ("", "nan", "inf", "-Infinity", "1_0", "١٢", "1e999", "1e16", "0x", "1e", "--1", "1 2",
                     "1" * 41, "1.5.", "½", "１")  # fmt: skip # noqa: RUF001
SAVED: Final[dict[str, Callable[[str], object]]] = {
    "height of an eddy current table": lambda text: EDDY.parse(f"{text}:9, 6:8, 7:7, 8:6"),
    "frequency of an eddy current table": lambda text: EDDY.parse(f"4:6, 5:{text}, 6:4, 7:3"),
    "height of a coil's drift": lambda text: DRIFT.parse(f"{text}: 1, 1, 1\n6: 1, 1, 1\n7: 1, 1, 1"),
    "factor of a coil's drift": lambda text: DRIFT.parse(f"4: 1, 1, {text}\n6: 1, 1, 1\n7: 1, 1, 1"),
    "place of a delta": lambda text: _numbers(f"1, {text}", 2),
    "phase of an endstop": lambda text: PhaseOption(name="x", help="").parse(f"{text}/64"),
    "phases of an endstop": lambda text: PhaseOption(name="x", help="").parse(f"4/{text}"),
}
"""What calibrations saved; each takes a 5."""
NUMBERS: Final = {"0": 0.0, "-1.5": -1.5, "+.5": 0.5, "2.": 2.0, "1e3": 1000.0, "12E-1": 1.2,
                  "1e-12": 1e-12, "9e-13": 0.0, "-1e-320": 0.0}  # fmt: skip
WAYS_IN: Final[dict[str, Callable[[str], object]]] = {
    "G-code, macros' results": lambda text: number("M104", {"S": text}, "S"),
    "configuration": FloatOption(name="x", help="").parse,
    "configuration, whole": IntOption(name="x", help="").parse,
    "command line": lambda text: parse_float(text, -1e15, 1e15),
    "command line, whole": parse_int,
    "command line, hex": lambda text: parse_hex(text, 2**32),
    "command line, ratio": parse_ratio,
    "command line, ppm": _ppm,
    "files": read_decimal,
    **SAVED,
}
REFUSED: Final = (WordError, BadValue, UsageError, ValueError, ArgumentTypeError)


@pytest.mark.parametrize("way_in", WAYS_IN)
def test_what_is_no_number_is_refused(way_in: str) -> None:
    """Failed before for G-code, the command line, saved calibrations: other scripts' digits, 1_0, nan."""
    for text in NO_NUMBERS:
        try:
            found = WAYS_IN[way_in](text)
        except REFUSED:
            continue
        assert found is None, text


def test_what_is_a_number_is_the_same_everywhere() -> None:
    for text, expected in NUMBERS.items():
        assert read_decimal(text) == expected
        assert number("M104", {"S": text}, "S") == expected
        assert FloatOption(name="x", help="").parse(text) == expected
        assert parse_float(text, -1e15, 1e15) == expected
    assert [read_int("0x1F", may_be_hex=True), read_int("0x1F"), read_int("-7")] == [31, None, -7]


def test_what_calibrations_saved_is_read_again() -> None:
    for read in SAVED.values():
        read("5")
        read(" 5 ")


@pytest.mark.parametrize(
    "text", ["1e999", "-1e999", "[1, 1e999]", "{'a': 1e999}", "...", "1e999-1e999", "1+2j", "b'x'"]
)
def test_a_saved_variable_can_be_read_again(text: str) -> None:
    """Failed before: ``inf`` and ``Ellipsis`` were written into the file, and the next start refused it."""
    with pytest.raises(ValueError, match="no value"):
        literal(text)
    assert math.isfinite(literal("1e300"))


@pytest.mark.parametrize(
    "text", ["0x" + "f" * 3_900, str(2**53), f"-{2**53}", f"[1, {2**64}]", f"{{{2**64}: 1}}", f"({2**64},)"]
)
def test_a_variable_has_no_number_that_others_cannot_read(text: str) -> None:
    """Failed before: msgpack ends at 64 bits, JSON at 4,300 digits, and browsers round from 2^53 on."""
    with pytest.raises(ValueError, match="whole number beyond 9007199254740991"):
        literal(text)
    assert literal(f"[{2**53 - 1}, {1 - 2**53}, 1e300]") == [2**53 - 1, 1 - 2**53, 1e300]

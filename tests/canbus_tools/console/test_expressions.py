"""Arithmetic of the console: exact, in bounds, and never more than arithmetic."""

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canbus_tools.console.expressions import ExpressionError, Quantity, evaluate, is_name, names_in

FREQ_HZ = 12_000_000
NAMES = {"clock": Quantity.clock(2**32 - 5), "start": Quantity.clock(7), "freq": Quantity(Fraction(FREQ_HZ))}


def value(text: str) -> int:
    return evaluate(text, NAMES, FREQ_HZ).whole()


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("0x10", 16),
        ("-3", -3),
        ("~5", -6),
        ("3*freq/1000", 36_000),
        ("50ms", 600_000),
        ("1.5us", 18),
        ("10/2s", 0),
        ("2s//3", 8_000_000),
        ("1/3*3", 1),
        ("max(100us, 3*freq//250000)", 1200),
        ("(1 << 31) | 1", 2**31 + 1),
        ("7 & 5 ^ 1", 4),
        ("round(2.5) + floor(-0.5) + ceil(0.5) + abs(-4)", 2 - 1 + 1 + 4),
        ("min(3, 1, 2)", 1),
        ("0.1*10", 1),
    ],
)
def test_values(text: str, wanted: int) -> None:
    assert value(text) == wanted


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "empty"),
        ("1" * 201, "at most 200"),
        ("9" * 199, "too long"),
        ("1e999", "too long"),
        ("1e99*1e99", "too long"),
        ("2**99", r"\*\*"),
        ("1 << 65", "0 to 64"),
        ("1 << -1", "0 to 64"),
        ("1/0", "divides by zero"),
        ("5 % (1-1)", "divides by zero"),
        ("1.5 | 1", "whole numbers"),
        ("clok + 1", "nothing is called 'clok'.*clock, freq, start"),
        ("__import__(1)", "there is no function"),
        ("clock.__class__", "only"),
        ("[1][0]", "only"),
        ("'a'", "not a number"),
        ("True", "not a number"),
        ("1j", "not a number"),
        ("1 if 2 else 3", "only"),
        ("2if 2 else 3", "no expression"),
        ("1 2", "no expression"),
        ("abs()", "one value"),
        ("min(1)", "two or more"),
        ("not 1", "arithmetic"),
        ("(" * 150 + "1" + ")" * 40, "no expression"),
    ],
)
def test_whatever_is_no_arithmetic_is_refused(text: str, said: str) -> None:
    with pytest.raises(ExpressionError, match=said):
        value(text)


def test_a_time_needs_a_frequency() -> None:
    with pytest.raises(ExpressionError, match="'2s' is a time"):
        evaluate("1+2s", {})


def test_a_clock_goes_round_and_a_duration_does_not() -> None:
    u32 = (0, 2**32 - 1)
    later = evaluate("clock + 10", NAMES, FREQ_HZ)
    assert later.for_range(*u32) == 5
    assert evaluate("clock - clock - 1", NAMES).for_range(*u32) == -1
    assert evaluate("clock - start", NAMES) == Quantity(Fraction(2**32 - 12))
    assert evaluate("2*freq*1000", NAMES).for_range(*u32) == 24_000_000_000
    assert evaluate("start - 10", NAMES).for_range(*u32) == 2**32 - 3


def test_a_signed_parameter_takes_a_clock_as_its_bits() -> None:
    assert evaluate("clock", NAMES).for_range(-(2**31), 2**31 - 1) == -5


@given(
    st.integers(-(2**40), 2**40),
    st.integers(-(2**40), 2**40),
    st.sampled_from(["+", "-", "*", "/", "//", "%", "&", "|", "^"]),
)
def test_it_agrees_with_exact_arithmetic(a: int, b: int, sign: str) -> None:
    if b == 0 and sign in {"/", "//", "%"}:
        return
    wanted: Fraction | int
    if sign in {"&", "|", "^"}:
        wanted = {"&": a & b, "|": a | b, "^": a ^ b}[sign]
    else:
        x, y = Fraction(a), Fraction(b)
        wanted = {
            "+": lambda: x + y,
            "-": lambda: x - y,
            "*": lambda: x * y,
            "/": lambda: x / y,
            "//": lambda: Fraction(x // y),
            "%": lambda: x % y,
        }[sign]()
    assert evaluate(f"({a}) {sign} ({b})", {}).value == wanted


@given(st.text(max_size=60))
def test_any_text_has_a_value_or_one_error(text: str) -> None:
    try:
        evaluate(text, NAMES, FREQ_HZ)
    except ExpressionError as error:
        assert str(error)  # noqa: PT017


def test_names() -> None:
    assert names_in("clock+2s*max(n, 3)") == {"clock", "max", "n"}
    assert is_name("start_2")
    assert not any(is_name(text) for text in ("2a", "ms", "min", "a b", ""))

"""Reading g-code in C: numbers as exactly as Python does, lines however they are spelled."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.motion.planner._planner import ffi, lib
from coordinator.motion.planner.planner import FeedStatus
from tests.coordinator.motion.planner_helpers import (
    check_invariants,
    drain,
    flushed,
    homed_planner,
    joined,
    planned,
)
from tests.profiles import examples


def number(text: bytes) -> tuple[int, float]:
    """Read a number: alone, where it is read digit by digit, and as every number in a text, eight at once."""
    alone, within = ffi.new("double *"), ffi.new("double *")
    taken = lib.gcode_number(text, len(text), alone)
    for behind in (b"\n0123456789.0123456789", b" /:@\x80\xff\x7f Y1.5 E7 and more", b"\0" * 20):
        within[0] = 0
        assert lib.gcode_number(text + behind, len(text + behind), within) == taken
        assert math.copysign(1, within[0]) == math.copysign(1, alone[0])
        assert within[0] == alone[0]
    return taken, alone[0]


# ---- Numbers ----


@given(st.decimals(allow_nan=False, allow_infinity=False, places=5, min_value=-(10**6), max_value=10**6))
def test_a_number_of_a_slicer_is_the_nearest_double(value: object) -> None:
    text = format(value, "f").encode()
    assert number(text) == (len(text), float(text))


@settings(max_examples=examples(500))
@given(
    st.integers(0, 10**19 - 1),
    st.integers(0, 19),
    st.sampled_from(["", "-", "+"]),
)
def test_every_number_of_up_to_19_digits_is_the_nearest_double(digits: int, decimals: int, sign: str) -> None:
    whole = str(digits).rjust(decimals + 1, "0")
    text = f"{sign}{whole[: len(whole) - decimals]}.{whole[len(whole) - decimals :]}".encode()
    assert number(text) == (len(text), float(text))


@given(st.floats(1e-3, 1e9))
def test_what_python_prints_is_read_back_exactly(value: float) -> None:
    assert number(repr(value).encode()) == (len(repr(value)), value)


@pytest.mark.parametrize(
    ("text", "taken", "value"),
    [
        (b".5", 2, 0.5),
        (b"-.5", 3, -0.5),
        (b"5.", 2, 5.0),
        (b"+7Y1", 2, 7.0),
        (b"1.2.3", 3, 1.2),
        (b"1e5", 1, 1.0),
        (b"000000000000000000000000001", 27, 1.0),
        (b"9007199254740993", 16, 9007199254740992.0),
        (b"9007199254740995", 16, 9007199254740996.0),
        (b"9999999999999999999", 19, 1e19),
    ],
)
def test_number(text: bytes, taken: int, value: float) -> None:
    assert number(text) == (taken, value)


@pytest.mark.parametrize(
    "text", [b"", b".", b"-", b"+.", b"--1", b"nan", b"inf", b"0x10", b" 1", b"1" * 20, b"0." + b"0" * 20]
)
def test_what_is_not_a_number_for_the_hot_path(text: bytes) -> None:
    taken = number(text)[0]
    assert taken == 0 or text == b"0x10"


# ---- Lines ----


@pytest.mark.parametrize(
    "line",
    [
        b"G1 X10 Y20 Z3 E1 F600",
        b"g1 f600 e1 z3 y20 x10",
        b"G01X10Y20Z3E1F600",
        b"  G1\tX+10. Y20.000 (to (here)Z3 E1 F600 ; and on X99",
        b"N12 G1 X10 Y20 Z3 E1 F600\r",
        b"N3 G0 X10 Y20 Z3 E1 F600*101",
    ],
)
@pytest.mark.parametrize("ending", [b"\n", b""])
def test_spellings_of_one_move(line: bytes, ending: bytes) -> None:
    planner = homed_planner()
    text = line + ending
    feed = planner.feed(text, 0, len(text), final=True)
    assert feed == (FeedStatus.NEED_DATA, len(text), 2)
    assert planner.toolhead_position == (10, 20, 3, 1)
    assert planner.speed_mm_s == 10


@pytest.mark.parametrize(
    "line",
    [
        *(b"M117 G1 X1", b"G10", b"G1.5 X1", b"G1 X", b"G1 X1 X2", b"G1 X1 S5", b"G1 Xnan", b"G1 X1e"),
        *(b"G1 Xinf", b"G1 X1 (open", b"N G1 X1", b"G1 X1*1", b"G1 X1*x", b"G1 X1*70 9", b"%", b"\x00"),
        *(b"G1_X", b"G111", b"G"),
    ],
)
def test_other_lines_stop_the_feed_where_they_stand(line: bytes) -> None:
    planner = homed_planner()
    before = b"; first\n\nG1 X5\n"
    text = before + line + b"\nG1 X6\n"
    feed = planner.feed(text, 0, len(text), final=True)
    assert feed == (FeedStatus.OTHER_LINE, len(before), 4)
    assert planner.toolhead_position[0] == 5


def test_a_line_is_read_when_it_is_whole() -> None:
    planner = homed_planner()
    assert planner.feed(b"G1 X5\nG1 X6", 0, 11, final=False) == (FeedStatus.NEED_DATA, 6, 2)
    assert planner.feed(b"G1 X6", 0, 5, final=True) == (FeedStatus.NEED_DATA, 5, 3)
    assert planner.toolhead_position[0] == 6


@settings(max_examples=examples(300))
@given(
    st.lists(st.one_of(st.binary(max_size=30), st.text("G1XYEF-.0123 *;()N\r", max_size=20).map(str.encode)))
)
def test_garbage_never_moves_what_it_should_not(lines: list[bytes]) -> None:
    planner = homed_planner()
    text = b"\n".join(lines)
    start = 0
    pieces = []
    while True:
        feed = planner.feed(text, start, len(text), final=True)
        assert start <= feed.offset <= len(text)
        assert feed.line == planner.lines + 1
        start = feed.offset
        if feed.status is FeedStatus.NEED_DATA:
            break
        assert feed.status in {FeedStatus.OTHER_LINE, FeedStatus.LIMIT}
        stop = text.find(b"\n", start)
        start = len(text) if stop < 0 else stop + 1
        planner.line_done()
        pieces += drain(planner)
    check_invariants(joined(pieces + flushed(planner)), end=planner.toolhead_position)


def test_g_code_state() -> None:
    planner = homed_planner()
    planner.unit_mm = 25.4
    planned(planner, b"G1 X1 F100")
    assert planner.toolhead_position[0] == 25.4
    assert planner.speed_mm_s == pytest.approx(100 * 25.4 / 60)
    planner.unit_mm = 1
    planner.set_gcode_position({"X": 0, "E": 100})
    planned(planner, b"G1 X10 E101")
    assert planner.toolhead_position == pytest.approx((35.4, 0, 0, 1))
    assert planner.gcode_position == pytest.approx((10, 0, 0, 101))
    planner.extrude_factor = 0.5
    assert planner.gcode_position == pytest.approx((10, 0, 0, 101))
    planned(planner, b"G1 X20 E103")
    assert planner.toolhead_position[3] == pytest.approx(2)
    planner.relative = True
    planned(planner, b"G1 X1 Y2 E2\nG1 X1 E2")
    assert planner.toolhead_position == pytest.approx((47.4, 2, 0, 4))
    planner.relative = False
    planner.relative_extrusion = True
    planned(planner, b"G1 X1 E2\nG1 X2 E2")
    assert planner.gcode_position[0] == pytest.approx(2)
    assert planner.toolhead_position[3] == pytest.approx(6)


def test_the_speed_factor_scales_the_speed() -> None:
    planner = homed_planner()
    planner.speed_factor = 0.5
    assert planned(planner, b"G1 X200 F6000")["cruise_v"][0] == 50

"""Sensors against numbers that their makers publish and the code does not contain."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.heat.known_sensors import (
    PT100,
    PT100_BOARD_GAIN,
    PT100_BOARD_PULLUP_OHMS,
    PT100_BOARD_SUPPLY_V,
    PT1000,
    THERMISTORS,
)
from coordinator.heat.resistors import Platinum, ResistanceTable, SensorError, SteinhartHart
from coordinator.heat.sensors import AmplifiedPullUp, PullUp, Sensor, Voltage, ratio_range
from coordinator.heat.thermocouples import AMPLIFIERS, amplifier, type_j_mv, type_k_mv

EPCOS = THERMISTORS["EPCOS 100K B57560G104F"].curve


def by_beta(r25: float, beta: float, celsius: float) -> float:
    return r25 * math.exp(beta * (1 / (celsius + 273.15) - 1 / 298.15))


@pytest.mark.parametrize(
    ("name", "celsius", "ohms", "part"),
    [
        # B25/100 = 4092 K and B25/85 = 4267, 4550 K: given beside the points that the curves go through.
        ("EPCOS 100K B57560G104F", 100, by_beta(100_000, 4092, 100), 0.002),
        ("ATC Semitec 104GT-2", 85, by_beta(100_000, 4267, 85), 0.003),
        ("ATC Semitec 104NT-4-R025H42G", 85, by_beta(100_000, 4267, 85), 0.003),
        ("TDK NTCG104LH104JT1", 85, by_beta(100_000, 4550, 85), 0.002),
        # Further rows of AMWEI's table.
        ("Generic 3950", 0, 322_959, 0.01),
        ("Generic 3950", 100, 6674, 0.012),
        ("Generic 3950", 200, 575, 0.01),
        ("Honeywell 100K 135-104LAG-J01", 25, 100_000, 1e-9),
        ("NTC 100K MGB18-104F39050L32", 25, 100_000, 1e-9),
        ("SliceEngineering 450", 200, 3734, 1e-9),
    ],
)
def test_thermistors_have_the_resistances_of_their_data_sheets(
    name: str, celsius: float, ohms: float, part: float
) -> None:
    assert THERMISTORS[name].curve.ohms(celsius) == pytest.approx(ohms, rel=part)
    assert THERMISTORS[name].source


@pytest.mark.parametrize("name", THERMISTORS)
@given(celsius=st.floats(-40, 450))
def test_thermistors_there_and_back(name: str, celsius: float) -> None:
    curve = THERMISTORS[name].curve
    assert curve.celsius(curve.ohms(celsius)) == pytest.approx(celsius, abs=1e-6)
    assert curve.ohms(celsius + 0.1) < curve.ohms(celsius)


@given(ohms=st.floats(0, 1e12), ratio=st.floats(-1, 2))
def test_nothing_that_can_be_read_raises(ohms: float, ratio: float) -> None:
    assert math.isfinite(EPCOS.celsius(ohms))
    assert math.isfinite(PT1000.celsius(ohms))
    for sensor in everything():
        assert math.isfinite(sensor.celsius(ratio))


def test_beta() -> None:
    curve = SteinhartHart.from_beta(25, 10_000, 3435)
    assert curve.ohms(50) == pytest.approx(by_beta(10_000, 3435, 50))
    assert curve.celsius(10_000) == pytest.approx(25)


def test_points_no_thermistor_goes_through_give_the_outer_ones() -> None:
    """Measured points bent the wrong way: c would be negative, and the curve turn back somewhere."""
    curve = SteinhartHart.from_points([(25, 103_180), (150, 1200), (250, 220)])
    assert curve.c == 0
    assert curve.ohms(25) == pytest.approx(103_180)
    assert curve.ohms(250) == pytest.approx(220)


@pytest.mark.parametrize(
    "points",
    [
        [(25, 1e5), (150, 1e5), (250, 200)],
        [(25, 100), (150, 1000), (250, 10_000)],
        [(25, 1e5), (25, 1e3), (250, 200)],
        [(25, 1e5), (150, 1e3), (250, 0)],
    ],
)
def test_points_that_do_not_fall_are_refused(points: list[tuple[float, float]]) -> None:
    with pytest.raises(SensorError, match="must fall"):
        SteinhartHart.from_points(points)


@pytest.mark.parametrize(
    ("celsius", "ohms"), [(-200, 18.52), (-100, 60.26), (0, 100), (100, 138.51), (200, 175.86), (850, 390.48)]
)
def test_platinum_as_iec_60751_tabulates_it(celsius: float, ohms: float) -> None:
    assert PT100.ohms(celsius) == pytest.approx(ohms, abs=0.006)
    assert PT100.celsius(PT100.ohms(celsius)) == pytest.approx(celsius, abs=1e-6)
    assert PT1000.ohms(celsius) == pytest.approx(10 * PT100.ohms(celsius))


def test_the_pt100_board() -> None:
    """Its maker's table: volts at a 5 V converter."""
    board = AmplifiedPullUp(PT100, PT100_BOARD_PULLUP_OHMS, PT100_BOARD_SUPPLY_V, PT100_BOARD_GAIN, 5.0)
    for celsius, volts in [(0, 1.11), (100, 1.52), (200, 1.92), (300, 2.29), (400, 2.66), (1100, 4.73)]:
        assert 5 * board.ratio(celsius) == pytest.approx(volts, abs=0.01)
        assert board.celsius(board.ratio(celsius)) == pytest.approx(celsius, abs=1e-6)


def test_thermocouples_as_iec_60584_tabulates_them() -> None:
    for celsius, millivolts in [(25, 1.000), (100, 4.096), (500, 20.644), (1000, 41.276)]:
        assert type_k_mv(celsius) == pytest.approx(millivolts, abs=0.001)
    for celsius, millivolts in [(25, 1.277), (100, 5.269), (500, 27.393), (700, 39.132)]:
        assert type_j_mv(celsius) == pytest.approx(millivolts, abs=0.001)


def test_amplifiers_of_thermocouples() -> None:
    # Output voltages from the AD595's data sheet.
    for celsius, volts in [(25, 0.250), (100, 1.015), (200, 2.015), (300, 3.022)]:
        assert amplifier("AD595", 5, 0).ratio(celsius) * 5 == pytest.approx(volts, abs=0.006)
    # 5 mV/K within the error that the application note tells: 2 K up to 400 °C.
    for celsius in (25, 100, 200, 300, 400):
        assert amplifier("AD8495", 5, 0).ratio(celsius) * 5 == pytest.approx(0.005 * celsius, abs=0.02)
    shifted = amplifier("AD8495", 3.3, 1.25)
    assert shifted.ratio(25) * 3.3 == pytest.approx(1.25 + 0.125, abs=1e-3)
    for name in AMPLIFIERS:
        sensor = amplifier(name, 5, 0)
        assert sensor.celsius(sensor.ratio(333.3)) == pytest.approx(333.3)


def test_a_pull_up_with_a_resistor_in_the_line() -> None:
    sensor = PullUp(EPCOS, 4700, 100)
    assert sensor.ratio(25) == pytest.approx(100_100 / 104_800)
    assert sensor.celsius(sensor.ratio(210)) == pytest.approx(210)


def everything() -> list[Sensor]:
    return [
        PullUp(EPCOS),
        PullUp(PT1000, 2200, 47),
        PullUp(ResistanceTable.from_points([(0, 1000), (100, 1385), (300, 2120)]), 4700),
        AmplifiedPullUp(Platinum(100), 4400, 5, 10, 3.3),
        Voltage.from_points([(25, 0.25), (200, 2.0), (400, 4.2)], 5.0),
        Voltage.from_points([(0, 3.0), (100, 2.0), (300, 0.5)], 3.3, 0.1),
        amplifier("AD597", 5, 0),
    ]


@pytest.mark.parametrize("index", range(7))
@given(celsius=st.floats(1, 240))
def test_every_sensor_there_and_back(index: int, celsius: float) -> None:
    sensor = everything()[index]
    ratio = sensor.ratio(celsius)
    if 1e-5 < ratio < 1 - 1e-5:
        assert sensor.celsius(ratio) == pytest.approx(celsius, abs=1e-3)


def test_tables_go_on_straight_beyond_their_ends() -> None:
    sensor = Voltage.from_points([(200, 2.0), (0, 0.0), (100, 1.2)], 5.0)
    assert sensor.ratio(50) * 5 == pytest.approx(0.6)
    assert sensor.ratio(300) * 5 == pytest.approx(2.8)
    assert sensor.celsius(0.4 / 5) == pytest.approx(100 / 3)


@pytest.mark.parametrize(
    ("points", "text"),
    [
        ([(0, 1.0)], "two points"),
        ([(0, 1.0), (0, 2.0)], "same temperature"),
        ([(0, 1.0), (10, 2.0), (20, 1.5)], "must rise"),
        ([(0, 1.0), (10, 1.0)], "must rise"),
    ],
)
def test_tables_that_turn_back_are_refused(points: list[tuple[float, float]], text: str) -> None:
    with pytest.raises(SensorError, match=text):
        Voltage.from_points(points)
    with pytest.raises(SensorError, match=text):
        ResistanceTable.from_points(points)


@pytest.mark.parametrize(("min_c", "max_c"), [(0, 300), (-40, 130), (-273, 300), (0, 1000)])
def test_the_range_leaves_out_broken_lines_whatever_the_limits(min_c: float, max_c: float) -> None:
    for sensor in everything():
        found = ratio_range(sensor, min_c, max_c)
        assert 0 < 1 / 4096 <= found.low < found.high <= 1 - 1 / 4096
        inside = sensor.ratio((max(min_c, 20) + min(max_c, 250)) / 2)
        assert found.low < inside < found.high


def test_the_range_is_that_of_the_temperatures() -> None:
    sensor = PullUp(EPCOS)
    found = ratio_range(sensor, 10, 290)
    assert sensor.celsius(found.low) == pytest.approx(290)
    assert sensor.celsius(found.high) == pytest.approx(10)


def test_limits_in_the_wrong_order_are_refused() -> None:
    with pytest.raises(SensorError, match="must be below max_temp"):
        ratio_range(PullUp(EPCOS), 300, 0)
    with pytest.raises(SensorError, match="reads the same"):
        ratio_range(Voltage.from_points([(0, 0.0), (100, 1.0)], 5.0), 2000, 3000)

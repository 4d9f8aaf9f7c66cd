"""Chips' own temperature sensors, against the examples and the typical figures of their data sheets."""

import pytest

from coordinator.heat.chip_sensors import CHIPS, ChipLine, ChipSensor, chip_sensor


def known(mcu: str) -> ChipSensor:
    sensor = chip_sensor(mcu)
    assert sensor is not None
    return sensor


@pytest.mark.parametrize(
    ("mcu", "volts", "celsius"),
    [
        ("rp2040", 0.706, 27.0),
        ("rp2040", 0.706 - 0.001721 * 10, 37.0),
        ("rp2350", 0.706, 27.0),
        ("stm32f103xe", 1.43, 25.0),
        ("stm32f103xe", 1.43 - 0.043, 35.0),
        ("stm32f072xb", 1.43, 30.0),
        ("stm32f407xx", 0.76 + 0.025, 35.0),
        ("stm32g0b1xx", 0.76, 30.0),
        ("stm32h723xx", 0.62 + 0.02, 40.0),
        ("sam3x8e", 0.8 + 0.0265, 37.0),
    ],
)
def test_typical_lines(mcu: str, volts: float, celsius: float) -> None:
    assert known(mcu).line().celsius(volts / 3.3) == pytest.approx(celsius)


def test_a_chip_that_nobody_knows_has_none() -> None:
    assert chip_sensor("atmega2560") is None
    assert chip_sensor("") is None


@pytest.mark.parametrize(
    ("mcu", "full_v"), [("stm32f407xx", 3.3), ("stm32g0b1xx", 3.0), ("stm32h743xx", 3.3)]
)
def test_what_the_factory_measured_is_taken(mcu: str, full_v: float) -> None:
    sensor = known(mcu)
    factory = sensor.factory
    assert factory is not None
    full = 2**factory.bits - 1

    def word(celsius: float) -> int:
        volts = sensor.volts + 0.02 + (celsius - sensor.celsius_at) * sensor.volts_per_k * 1.05
        word: int = round(volts / full_v * full)
        return word

    line = sensor.corrected(word(factory.first_c), word(factory.second_c))
    assert line is not None
    for celsius in (0.0, 30.0, 80.0):
        at_3v3 = word(celsius) / full * full_v / 3.3
        assert line.celsius(at_3v3) == pytest.approx(celsius, abs=0.6)


@pytest.mark.parametrize(
    "words", [(0, 0), (0xFFFF, 0xFFFF), (0, 0xFFFF), (900, 901), (1300, 900), (3000, 3150)]
)
def test_an_erased_or_a_strange_memory_is_not_taken(words: tuple[int, int]) -> None:
    assert known("stm32f407xx").corrected(*words) is None


def test_without_points_of_the_factory_there_is_nothing_to_take() -> None:
    assert known("rp2040").corrected(900, 1000) is None


def test_two_points_of_the_users_own() -> None:
    line = ChipLine.through(20.0, 0.4, 60.0, 0.3)
    assert line.celsius(0.35) == pytest.approx(40.0)


def test_every_chip_has_a_sensible_slope() -> None:
    for name, sensor in CHIPS.items():
        assert 0.001 < abs(sensor.volts_per_k) < 0.01, name

"""The options of a temperature sensor, wherever a section has one."""

from typing import Final

from coordinator.machine.options import FloatOption, TextOption
from coordinator.machine.pins import PinOption

SENSOR_TYPE: Final = TextOption(
    name="sensor_type",
    help="a sensor known by name, or NAME of [thermistor NAME] or [adc_temperature NAME]",
    pattern_rule="the name of a sensor",
)
SENSOR_PIN: Final = PinOption(
    name="sensor_pin",
    help="analog input of the sensor",
    invertible=False,
)
PULLUP: Final = FloatOption(
    name="pullup_resistor",
    help="resistor from a thermistor or PT1000 to the converter's reference",
    default=4700.0,
    unit="Ω",
    above=0,
    maximum=10_000_000,
)
INLINE: Final = FloatOption(
    name="inline_resistor",
    help="resistor in the line of a thermistor or PT1000",
    default=0.0,
    unit="Ω",
    minimum=0,
    maximum=10_000_000,
)
ADC_VOLTAGE: Final = FloatOption(
    name="adc_voltage",
    help="reference of the converter, for sensors that give a voltage",
    default=5.0,
    unit="V",
    above=0,
    maximum=100,
)
VOLTAGE_OFFSET: Final = FloatOption(
    name="voltage_offset",
    help="what is added to the voltage of a sensor's amplifier",
    default=0.0,
    unit="V",
    minimum=-100,
    maximum=100,
)
MIN_TEMP: Final = FloatOption(
    name="min_temp",
    help="lowest temperature that makes sense; below it the node stops everything",
    unit="°C",
    minimum=-273.15,
    maximum=1500,
)
MAX_TEMP: Final = FloatOption(
    name="max_temp",
    help="highest temperature allowed; above it the node stops everything",
    unit="°C",
    minimum=-273.15,
    maximum=1500,
)
SENSOR_OPTIONS: Final = (
    SENSOR_TYPE,
    SENSOR_PIN,
    PULLUP,
    INLINE,
    ADC_VOLTAGE,
    VOLTAGE_OFFSET,
    MIN_TEMP,
    MAX_TEMP,
)


def _words(text: str) -> tuple[str, ...]:
    return tuple(text.split())


LATER_SENSOR_OPTIONS: Final = (
    *_words("sensor_mcu sensor_path tc_type tc_use_50hz_filter tc_averaging_count rtd_nominal_r"),
    *_words("rtd_reference_r rtd_num_of_wires rtd_use_50hz_filter spi_speed spi_bus"),
    *_words("spi_software_sclk_pin spi_software_mosi_pin spi_software_miso_pin"),
    *_words("i2c_address i2c_mcu i2c_bus i2c_speed i2c_software_scl_pin i2c_software_sda_pin"),
)
"""Of sensors on SPI and I2C, which are not built yet."""
LATER_SENSORS: Final = frozenset(
    (
        *_words("MAX6675 MAX31855 MAX31856 MAX31865 BME280 BMP280 BMP180 BMP388 BME680 AHT10 AHT20 AHT21"),
        *_words("HTU21D SI7013 SI7020 SI7021 SHT21 SHT3X LM75 DS18B20 SDS011"),
        *_words("temperature_host temperature_mcu temperature_combined"),
    )
)
"""Sensors known from other hosts that do not act yet."""

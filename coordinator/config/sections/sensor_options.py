"""The options of a temperature sensor, wherever a section has one."""

from typing import Final

from coordinator.config.options import ChoiceOption, FloatOption, ListOption, TextOption
from coordinator.config.pins import PinOption

SENSOR_TYPE: Final = TextOption(
    name="sensor_type",
    help="a sensor known by name, NAME of [thermistor NAME] or [adc_temperature NAME], or, but for heaters,"
    " temperature_mcu, temperature_host or temperature_combined",
    pattern_rule="the name of a sensor",
)
SENSOR_PIN: Final = PinOption(
    name="sensor_pin",
    help="analog input of the sensor; none for temperature_mcu, temperature_host and temperature_combined",
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
    help="offset of the voltage of a sensor's amplifier",
    default=0.0,
    unit="V",
    minimum=-100,
    maximum=100,
)
MIN_TEMP: Final = FloatOption(
    name="min_temp",
    help="lowest plausible temperature; below it the node stops the machine",
    unit="°C",
    minimum=-273.15,
    maximum=1500,
)
MAX_TEMP: Final = FloatOption(
    name="max_temp",
    help="highest temperature allowed; above it the node stops the machine",
    unit="°C",
    minimum=-273.15,
    maximum=1500,
)
SENSOR_MCU: Final = TextOption(
    name="sensor_mcu",
    help="temperature_mcu: the node whose chip is measured",
    default="mcu",
    pattern_rule="the name of a node: mcu, or NAME of [mcu NAME]",
)


def _chip_point(number: int) -> tuple[FloatOption, FloatOption]:
    return (
        FloatOption(
            name=f"sensor_temperature{number}",
            help=f"temperature_mcu: a temperature that you have measured, with sensor_adc{number}",
            unit="°C",
            minimum=-100,
            maximum=300,
        ),
        FloatOption(
            name=f"sensor_adc{number}",
            help="temperature_mcu: what the converter read then, as a part of full scale",
            minimum=0,
            maximum=1,
        ),
    )


CHIP_POINTS: Final = (_chip_point(1), _chip_point(2))
SENSOR_PATH: Final = TextOption(
    name="sensor_path",
    help="temperature_host: the file that has the temperature, in thousandths of a °C",
    default="/sys/class/thermal/thermal_zone0/temp",
    pattern_rule="the path of a file",
)
SENSOR_LIST: Final = ListOption(
    name="sensor_list",
    help="temperature_combined: sections of sensors and heaters, as in temperature_sensor NAME, separated by"
    " commas",
)
COMBINATION_METHOD: Final = ChoiceOption(
    name="combination_method",
    help="temperature_combined: how they are combined",
    default="mean",
    choices=("min", "max", "mean"),
)
MAXIMUM_DEVIATION: Final = FloatOption(
    name="maximum_deviation",
    help="temperature_combined: how far they may be apart; farther stops the machine",
    unit="K",
    above=0,
    maximum=1500,
)
FREE_SENSOR_OPTIONS: Final = (
    SENSOR_MCU,
    *CHIP_POINTS[0],
    *CHIP_POINTS[1],
    SENSOR_PATH,
    SENSOR_LIST,
    COMBINATION_METHOD,
    MAXIMUM_DEVIATION,
)
"""Of sensors that no heater may depend upon."""
FREE_SENSORS: Final = ("temperature_mcu", "temperature_host", "temperature_combined")
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


UNSUPPORTED_SENSOR_OPTIONS: Final = (
    *_words("tc_type tc_use_50hz_filter tc_averaging_count rtd_nominal_r"),
    *_words("rtd_reference_r rtd_num_of_wires rtd_use_50hz_filter spi_speed spi_bus"),
    *_words("spi_software_sclk_pin spi_software_mosi_pin spi_software_miso_pin"),
    *_words("i2c_address i2c_mcu i2c_bus i2c_speed i2c_software_scl_pin i2c_software_sda_pin"),
    *_words("serial_no ds18_report_time bme280_report_time bme280_gas_target_temp bme280_gas_heat_duration"),
    *_words("bme280_oversample_temp bme280_oversample_hum bme280_oversample_pressure bme280_iir_filter"),
    *_words("aht10_report_time htu21d_hold_master htu21d_resolution htu21d_report_time sht3x_report_time"),
    *_words("lm75_report_time"),
)
"""Of sensors on SPI, I2C and a single wire, which are not supported yet."""
UNSUPPORTED_SENSORS: Final = frozenset(
    (
        *_words("MAX6675 MAX31855 MAX31856 MAX31865 BME280 BMP280 BMP180 BMP388 BME680 AHT10 AHT20 AHT21"),
        *_words("HTU21D SI7013 SI7020 SI7021 SHT21 SHT3X LM75 DS18B20 SDS011"),
    )
)
"""Sensors known from other hosts that are not supported yet."""

"""[thermistor NAME] and [adc_temperature NAME]: sensors of the user's own."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar, Final

from coordinator.config.errors import ConfigError
from coordinator.config.options import FloatOption, SectionSpec
from coordinator.heat.resistors import ResistanceTable, Resistor, SensorError, SteinhartHart
from coordinator.heat.sensors import PullUp, Sensor, Voltage
from coordinator.modules.base import Build, Module

MAX_POINTS: Final = 40


@dataclass(frozen=True, slots=True)
class Circuit:
    """What a sensor is connected with, as the section that uses it says."""

    pullup_ohms: float
    inline_ohms: float
    adc_v: float
    offset_v: float


class CustomSensor(Module):
    """A sensor that other sections name."""

    def sensor(self, circuit: Circuit) -> Sensor:
        """Return the sensor within CIRCUIT."""
        raise NotImplementedError


def _temperature(number: int) -> FloatOption:
    return FloatOption(
        name=f"temperature{number}",
        help=f"temperature of point {number}",
        unit="°C",
        above=-273.15,
        maximum=3000,
    )


def _ohms(number: int) -> FloatOption:
    return FloatOption(
        name=f"resistance{number}", help=f"resistance at point {number}", unit="Ω", above=0, maximum=1e9
    )


def _volts(number: int) -> FloatOption:
    return FloatOption(
        name=f"voltage{number}", help=f"voltage at point {number}", unit="V", minimum=-100, maximum=100
    )


THERMISTOR_POINTS: Final = tuple((_temperature(n), _ohms(n)) for n in (1, 2, 3))
BETA: Final = FloatOption(
    name="beta",
    help="B value of the thermistor, instead of the second and third point",
    unit="K",
    above=0,
    maximum=20_000,
)


class Thermistor(CustomSensor):
    """A thermistor by three points, or by one and beta."""

    NAMED: ClassVar = True
    SPEC: ClassVar = SectionSpec(
        help="A thermistor of your own, by three of its points (Steinhart-Hart) or by one and beta; sections"
        " with a sensor name it as their sensor_type",
        options=(*(option for point in THERMISTOR_POINTS for option in point), BETA),
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        beta = build.find(BETA)
        used = THERMISTOR_POINTS[: 3 if beta is None else 1]
        points = [(build.get(celsius), build.get(ohms)) for celsius, ohms in used]
        try:
            self._curve: Resistor = (
                SteinhartHart.from_points(points)
                if beta is None
                else SteinhartHart.from_beta(*points[0], beta)
            )
        except SensorError as error:
            raise ConfigError(build.place, f"[{build.name}]: {error}") from None

    def sensor(self, circuit: Circuit) -> Sensor:
        """Return the sensor within CIRCUIT."""
        return PullUp(self._curve, circuit.pullup_ohms, circuit.inline_ohms)


ADC_POINTS: Final = tuple((_temperature(n), _volts(n), _ohms(n)) for n in range(1, MAX_POINTS + 1))


class AdcTemperature(CustomSensor):
    """A sensor by its voltages or its resistances at some temperatures."""

    NAMED: ClassVar = True
    SPEC: ClassVar = SectionSpec(
        help="A sensor of your own, by its voltages or its resistances at 2 to 40 temperatures, with straight"
        " lines between; sections with a sensor name it as their sensor_type",
        options=tuple(option for point in ADC_POINTS for option in point),
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        given = list(_given(build))
        self._place, self._name = build.place, build.name
        self._by_voltage = bool(given) and given[0][1]
        self._points = [(celsius, value) for celsius, _, value in given]
        try:
            Voltage.from_points(self._points)
        except SensorError as error:
            raise ConfigError(build.place, f"[{build.name}]: {error}") from None

    def sensor(self, circuit: Circuit) -> Sensor:
        """Return the sensor within CIRCUIT."""
        if self._by_voltage:
            return Voltage.from_points(self._points, circuit.adc_v, circuit.offset_v)
        return PullUp(ResistanceTable.from_points(self._points), circuit.pullup_ohms, circuit.inline_ohms)


def _given(build: Build) -> Iterator[tuple[float, bool, float]]:
    """Yield temperature, whether it has a voltage, and voltage or resistance of all points."""
    kind: bool | None = None
    for celsius, volts, ohms in ADC_POINTS:
        at, v, r = build.find(celsius), build.find(volts), build.find(ohms)
        if at is None and v is None and r is None:
            continue
        value = r if v is None else v
        if at is None or value is None or (v is not None and r is not None):
            raise ConfigError(
                build.place,
                f"[{build.name}]: '{celsius.name}' needs either '{volts.name}' or '{ohms.name}' as well",
            )
        if kind is not None and kind is not (v is not None):
            raise ConfigError(build.place, f"[{build.name}] mixes voltages and resistances; use one kind")
        kind = v is not None
        yield at, kind, value


KINDS: Final[Mapping[str, type[CustomSensor]]] = {"thermistor": Thermistor, "adc_temperature": AdcTemperature}
"""By the first word of their sections."""

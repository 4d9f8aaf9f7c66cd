"""A temperature on an analog input, for whatever module has one."""

from typing import Final

from coordinator.config.errors import ConfigError, NotSupported
from coordinator.config.options import FloatOption
from coordinator.config.sections.sensor_options import (
    ADC_VOLTAGE,
    FREE_SENSORS,
    INLINE,
    MAX_TEMP,
    MIN_TEMP,
    PULLUP,
    SENSOR_PIN,
    SENSOR_TYPE,
    UNSUPPORTED_SENSORS,
    VOLTAGE_OFFSET,
)
from coordinator.heat.known_sensors import (
    PT100,
    PT100_BOARD_GAIN,
    PT100_BOARD_PULLUP_OHMS,
    PT100_BOARD_SUPPLY_V,
    PT1000,
    THERMISTORS,
)
from coordinator.heat.resistors import SensorError
from coordinator.heat.sensors import AmplifiedPullUp, PullUp, Sensor, ratio_range
from coordinator.heat.thermocouples import AMPLIFIERS, amplifier
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.sensors.temperature_source import TemperatureSource
from coordinator.modules.sensors.thermistor import KINDS, Circuit, CustomSensor
from coordinator.runtime.module_context import ModuleContext
from coordinator.support.quoting import nearest, shown
from nodes.devices.analog_in import AnalogIn, AnalogValue
from nodes.node.states import NodeState

PT100_BOARD: Final = "PT100 INA826"
KNOWN_SENSORS: Final = (*THERMISTORS, "PT1000", PT100_BOARD, *AMPLIFIERS)

WIRE_BREAK: Final = 0.01
"""A converter this near (as a ratio) to an end of its range has no sensor, or a shorted one."""


class TemperatureInput(TemperatureSource):
    """The sensor of section BUILD; ``on_measured`` is called with every measurement once it is connected."""

    def __init__(self, build: Build, *, min_c: float | None = None, max_c: float | None = None) -> None:
        """Read the options of the sensor; where the section need not limit it MIN_C and MAX_C are given.

        A sensor that is not limited does not stop its node when its wire breaks.
        """
        self._type = build.get(SENSOR_TYPE)
        if self._type in UNSUPPORTED_SENSORS:
            place = build.reader.place_of(SENSOR_TYPE)
            raise NotSupported(place, f"its sensor is a {self._type}, which is not supported yet")
        super().__init__(build.name, limit(build, MIN_TEMP, min_c), limit(build, MAX_TEMP, max_c))
        self._pin = build.pin(SENSOR_PIN)
        self.guarded = min_c is None or is_limited(build)
        self._reader = build.reader
        self._circuit = Circuit(
            build.get(PULLUP), build.get(INLINE), build.get(ADC_VOLTAGE), build.get(VOLTAGE_OFFSET)
        )
        self._sensor: Sensor | None = None
        self._analog = AnalogIn(build.name, pin=self._pin.name)
        self._analog.on_value = self._came
        self._analog.describe = self._out_of_range
        build.add_device(self._pin.node, self._analog, self._pin)

    def link(self, modules: Modules) -> None:
        """Find the sensor, and what its converter may read; raises ConfigError."""
        self._sensor = self._find(modules)
        if not self.guarded:
            return
        try:
            limits = ratio_range(self._sensor, self.min_c, self.max_c)
        except SensorError as error:
            raise ConfigError(self._reader.place_of(SENSOR_TYPE), f"[{self.name}]: {error}") from None
        self._analog.limit(limits.low, limits.high)

    def _find(self, modules: Modules) -> Sensor:
        name, circuit = self._type, self._circuit
        for word, kind in KINDS.items():
            custom: CustomSensor | None = modules.find(f"{word} {name}", kind)
            if custom is not None:
                return custom.sensor(circuit)
        if name in THERMISTORS:
            return PullUp(THERMISTORS[name].curve, circuit.pullup_ohms, circuit.inline_ohms)
        if name == "PT1000":
            return PullUp(PT1000, circuit.pullup_ohms, circuit.inline_ohms)
        if name == PT100_BOARD:
            board = PT100_BOARD_PULLUP_OHMS, PT100_BOARD_SUPPLY_V, PT100_BOARD_GAIN
            return AmplifiedPullUp(PT100, *board, circuit.adc_v)
        if name in AMPLIFIERS:
            return amplifier(name, circuit.adc_v, circuit.offset_v)
        raise self._unknown(modules)

    def _unknown(self, modules: Modules) -> ConfigError:
        if self._type in FREE_SENSORS:
            return self._reader.bad(
                SENSOR_TYPE,
                "which no node can check: a heater needs a sensor on a pin, whose limits its node checks",
            )
        own = [name.partition(" ")[2] for kind in KINDS.values() for name in modules.names(kind)]
        hint = nearest(self._type, (*KNOWN_SENSORS, *own), pattern="'{}'")
        add = f"; add a section [thermistor {self._type}]"
        return self._reader.bad(SENSOR_TYPE, f"but there is no sensor {shown(self._type)}{hint or add}")

    # ----------------------------------------------------------------------------------------- connected

    async def connect(self, live: "ModuleContext") -> None:
        """Start reporting measurements; waits for the first one, unless its node is absent."""
        await super().connect(live)
        if self.celsius is None and live.node(self._pin.node).state is NodeState.READY:
            await self.next()

    @property
    def node(self) -> str:
        """The node it is on."""
        return self._pin.node

    def _out_of_range(self, ratio: float) -> str:
        assert self._sensor is not None
        found = f"{self._sensor.celsius(ratio):.0f} °C, allowed are {self.min_c:g} to {self.max_c:g} °C"
        at_the_end = not WIRE_BREAK < ratio < 1 - WIRE_BREAK
        return f"{found}; is a wire broken or shorted?" if at_the_end else found

    def _came(self, value: AnalogValue) -> None:
        assert self._sensor is not None
        celsius = self._sensor.celsius(value.ratio)
        self.ratio = value.ratio
        self._take(celsius, lambda live: live.print_time_of(self._pin.node, value.clock32))


class SensorModule(Module):
    """A section that measures a temperature."""

    input: TemperatureSource


def limit(build: Build, option: FloatOption, otherwise: float | None) -> float:
    """Return MIN_TEMP or MAX_TEMP, OTHERWISE where it is absent; None: it is required; raises ConfigError."""
    if otherwise is None:
        return build.get(option)
    given = build.find(option)
    return otherwise if given is None else given


def is_limited(build: Build) -> bool:
    """Return whether the section has a min_temp or a max_temp."""
    return build.reader.has(MIN_TEMP) or build.reader.has(MAX_TEMP)

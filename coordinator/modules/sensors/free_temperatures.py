"""Temperatures without a pin: of a node's own chip, of the host's computer, of several sensors together.

No node checks them, so no heater may depend on them; the host stops the machine when they leave min_temp and
max_temp.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from coordinator.config.errors import ConfigError
from coordinator.config.sections.sensor_options import (
    CHIP_POINTS,
    COMBINATION_METHOD,
    MAX_TEMP,
    MAXIMUM_DEVIATION,
    MIN_TEMP,
    SENSOR_LIST,
    SENSOR_MCU,
    SENSOR_PATH,
    SENSOR_TYPE,
)
from coordinator.heat.chip_sensors import ChipLine, ChipSensor, FactoryPoints, chip_sensor
from coordinator.modules.base import Build, Modules
from coordinator.modules.heaters.heaters import HeaterRegistry
from coordinator.modules.sensors.temperature_input import TemperatureInput, is_limited, limit
from coordinator.modules.sensors.temperature_source import TemperatureSource
from coordinator.runtime.module_context import ModuleContext
from coordinator.support.quoting import nearest_or_all, shown
from nodes.devices.analog_in import AnalogIn, AnalogValue
from nodes.dictionary.vocabulary import carries
from nodes.node.config import NodeConfig, NodeConfigError
from nodes.node.node import Node
from nodes.node.states import NodeState
from nodes.support.errors import CanductorError
from nodes.support.numbers import read_int
from nodes.support.regular_file import read_regular

LOWEST_C: Final = -273.15
HIGHEST_C: Final = 1500.0
CHIP_PIN: Final = "ADC_TEMPERATURE"
"""Name of the channel of the chip's own sensor in firmware."""
HOST_S: Final = 1.0
COMBINED_S: Final = 0.3
HALF_WORD: Final = 1
READ_RESPONSE: Final = "debug_result val=%u"


class ChipTemperature(TemperatureSource):
    """The temperature of a node's chip."""

    def __init__(self, build: Build, min_c: float, max_c: float) -> None:
        super().__init__(build.name, min_c, max_c)
        self._node = build.get(SENSOR_MCU)
        names = [node.name for node in build.machine.nodes]
        if self._node not in names:
            hint = nearest_or_all(self._node, names)
            raise build.reader.bad(SENSOR_MCU, f"but there is no node {shown(self._node)}{hint}")
        self._own = _own_line(build)
        self._chip: ChipSensor | None = None
        self._line: ChipLine | None = None
        self._analog = AnalogIn(build.name, pin=CHIP_PIN)
        self._analog.on_value = self._came
        build.add_device(self._node, self)

    def configure(self, config: NodeConfig) -> None:
        """Add it to its node's CONFIG; raises NodeConfigError."""
        pins = config.dictionary.enumerations.get("pin")
        if pins is None or CHIP_PIN not in pins.values:
            raise NodeConfigError(
                f"[{self.name}]: the firmware of node {self._node} has no sensor for its chip's temperature;"
                " remove the section, or have firmware that has one"
            )
        mcu = str(config.dictionary.constants.get("MCU", ""))
        self._chip = chip_sensor(mcu)
        if self._chip is None and self._own is None:
            raise NodeConfigError(
                f"[{self.name}]: it is not known what the sensor of a {mcu} gives; measure twice, and give"
                " sensor_temperature1, sensor_adc1, sensor_temperature2 and sensor_adc2"
            )
        self._line = self._own or (self._chip.line() if self._chip is not None else None)
        self._analog.configure(config)

    def started(self, node: "Node") -> None:
        """Start measuring: NODE has become ready."""
        self._analog.started(node)

    @property
    def node(self) -> str:
        """The node it is on."""
        return self._node

    async def connect(self, live: "ModuleContext") -> None:
        """Start reporting; read the calibration values of the chip's factory."""
        await super().connect(live)
        node = live.node(self._node)
        if node.state is not NodeState.READY:
            return
        factory = None if self._chip is None else self._chip.factory
        can_read = "debug_read" in node.dictionary.commands and carries(node.dictionary, READ_RESPONSE)
        if self._own is None and factory is not None and can_read:
            await self._correct(node, factory)
        if self.celsius is None:
            await self.next()

    async def _correct(self, node: "Node", factory: FactoryPoints) -> None:
        words = []
        for address in (factory.first, factory.second):
            answer = await node.query("debug_read", "debug_result", order=HALF_WORD, addr=address)
            words.append(answer.integer("val") & 0xFFFF)
        assert self._chip is not None
        self._line = self._chip.corrected(*words) or self._line

    def _came(self, value: AnalogValue) -> None:
        assert self._line is not None
        celsius = self._line.celsius(value.ratio)
        self.ratio = value.ratio
        if self._live is not None:
            self._watch(self._live, celsius)
        self._take(celsius, lambda live: live.print_time_of(self._node, value.clock32))


def _own_line(build: Build) -> ChipLine | None:
    """Return the line through what the user has measured; None: nothing was."""
    given = [(build.find(celsius), build.find(adc)) for celsius, adc in CHIP_POINTS]
    if all(value is None for point in given for value in point):
        return None
    (c1, r1), (c2, r2) = given
    if c1 is None or r1 is None or c2 is None or r2 is None or r1 == r2 or c1 == c2:
        raise ConfigError(
            build.place,
            f"[{build.name}] needs all of sensor_temperature1, sensor_adc1, sensor_temperature2 and"
            " sensor_adc2, two different points, or none of them",
        )
    return ChipLine.through(c1, r1, c2, r2)


class HostTemperature(TemperatureSource):
    """The temperature of the host's computer, from a file of its kernel."""

    def __init__(self, build: Build, min_c: float, max_c: float) -> None:
        super().__init__(build.name, min_c, max_c)
        self._path = Path(build.get(SENSOR_PATH))

    async def connect(self, live: "ModuleContext") -> None:
        """Start reading; raises CanductorError when the file cannot be read."""
        await super().connect(live)
        self._look()
        live.every(HOST_S, self._look_again)

    def _look(self) -> None:
        try:
            text = read_regular(self._path, 64).decode("ascii", "replace").strip()
        except OSError as error:
            raise CanductorError(
                f"[{self.name}]: {self._path} cannot be read: {error.strerror}; correct sensor_path"
            ) from None
        thousandths = read_int(text)
        if thousandths is None:
            raise CanductorError(
                f"[{self.name}]: {self._path} holds {shown(text)}, not thousandths of a °C; correct"
                " sensor_path"
            )
        celsius = thousandths / 1000
        if self._live is not None:
            self._watch(self._live, celsius)
        self._take(celsius, lambda live: live.print_time_now())

    def _look_again(self) -> None:
        live = self._live
        if live is None:
            return
        try:
            self._look()
        except CanductorError as error:
            if self.celsius is not None:
                live.say(str(error))
            self.celsius = None  # unknown, until the file is back


class CombinedTemperature(TemperatureSource):
    """The minimum, maximum or mean of the temperatures of other sections."""

    def __init__(self, build: Build, min_c: float, max_c: float) -> None:
        super().__init__(build.name, min_c, max_c)
        self._heaters = build.shared(HeaterRegistry)
        self._names = build.get(SENSOR_LIST)
        self._method = build.get(COMBINATION_METHOD)
        self._deviation_k = build.find(MAXIMUM_DEVIATION)
        self._reader = build.reader
        self._sources: list[TemperatureSource] = []

    def link(self, modules: Modules) -> None:
        """Find the others."""
        del modules
        known: Mapping[str, TemperatureSource] = self._heaters.sensors
        for name in self._names:
            source = known.get(name)
            if source is None or source is self:
                others = [other for other in known if known[other] is not self]
                hint = nearest_or_all(name, others)
                why = "this section itself" if source is self else f"{shown(name)}, which does not exist"
                raise ConfigError(
                    self._reader.place_of(SENSOR_LIST), f"'sensor_list' of [{self.name}] names {why}{hint}"
                )
            self._sources.append(source)

    async def connect(self, live: "ModuleContext") -> None:
        """Start the periodic calculation."""
        await super().connect(live)
        live.every(COMBINED_S, self._look)

    def _look(self) -> None:
        live = self._live
        known = [source.celsius for source in self._sources if source.celsius is not None]
        if live is None or len(known) < len(self._sources):
            self.celsius = None
            return
        apart = max(known) - min(known)
        if self._deviation_k is not None and apart > self._deviation_k:
            listed = ", ".join(f"{s.name} {c:.1f} °C" for s, c in zip(self._sources, known, strict=True))
            live.stop(
                f"[{self.name}]: its sensors are {apart:.1f} K apart, more than maximum_deviation"
                f" ({self._deviation_k:g} K): {listed}; find out which of them is wrong"
            )
            return
        values = {"min": min(known), "max": max(known), "mean": sum(known) / len(known)}
        celsius = values[self._method]
        self._watch(live, celsius)
        self._take(celsius, lambda live: live.print_time_now())


_FREE: Final[dict[str, type[ChipTemperature | HostTemperature | CombinedTemperature]]] = {
    "temperature_mcu": ChipTemperature,
    "temperature_host": HostTemperature,
    "temperature_combined": CombinedTemperature,
}
"""By sensor_type."""


def find_source(build: Build, plausible: tuple[float, float] | None = None) -> TemperatureSource:
    """Return the temperature of section BUILD, whatever its sensor_type; raises ConfigError.

    PLAUSIBLE: what stands in for a min_temp and a max_temp that are not given; None: they have to be. Where
    neither is given no reading stops the machine.
    """
    free = _FREE.get(build.get(SENSOR_TYPE))
    low, high = plausible or (None, None)
    if free is None:
        return TemperatureInput(build, min_c=low, max_c=high)
    source = free(build, limit(build, MIN_TEMP, low), limit(build, MAX_TEMP, high))
    source.guarded = plausible is None or is_limited(build)
    return source

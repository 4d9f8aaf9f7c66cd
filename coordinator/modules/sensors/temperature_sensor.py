"""[temperature_sensor NAME]: a temperature that is only reported."""

from collections.abc import Mapping
from typing import ClassVar, Final

from coordinator.config.options import SectionSpec, TextOption
from coordinator.config.sections.sensor_options import (
    FREE_SENSOR_OPTIONS,
    SENSOR_OPTIONS,
    UNSUPPORTED_SENSOR_OPTIONS,
)
from coordinator.modules.base import Build, Modules
from coordinator.modules.heaters.heaters import HeaterRegistry
from coordinator.modules.sensors.free_temperatures import HIGHEST_C, LOWEST_C, find_source
from coordinator.modules.sensors.temperature_input import SensorModule
from coordinator.runtime.module_context import ModuleContext
from coordinator.support.values import Value

GCODE_ID: Final = TextOption(
    name="gcode_id",
    help="its name in M105; without one M105 does not report it",
    pattern=r"[A-Za-z][A-Za-z0-9_]*",
    pattern_rule="a letter, and letters and digits",
)


class TemperatureSensor(SensorModule):
    """A sensor of no heater."""

    NAMED: ClassVar = True
    SPEC: ClassVar = SectionSpec(
        help="A temperature that is reported; outside min_temp or max_temp its node stops the machine",
        options=(*SENSOR_OPTIONS, *FREE_SENSOR_OPTIONS, GCODE_ID),
        unsupported=UNSUPPORTED_SENSOR_OPTIONS,
    )

    PLAUSIBLE: ClassVar = (LOWEST_C, HIGHEST_C)
    """What min_temp and max_temp are where they are not given."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.input = find_source(build, self.PLAUSIBLE)
        self.input.on_measured = self._measured
        self._extremes: tuple[float, float] | None = None
        build.shared(HeaterRegistry).add_sensor(self.input, build.find(GCODE_ID) or "")

    def link(self, modules: Modules) -> None:
        """Find the sensor."""
        self.input.link(modules)

    async def connect(self, live: "ModuleContext") -> None:
        """Start measuring."""
        await super().connect(live)
        await self.input.connect(live)

    def end(self, cause: str) -> None:
        """Stop measuring."""
        self.input.end(cause)

    def _measured(self, _at_s: float, celsius: float) -> None:
        low, high = self._extremes or (celsius, celsius)
        self._extremes = min(low, celsius), max(high, celsius)

    def status(self) -> Mapping[str, Value]:
        """Report the temperature, and the lowest and highest since the start."""
        celsius = self.input.celsius
        low, high = self._extremes or (None, None)
        return {
            "temperature": None if celsius is None else round(celsius, 2),
            "measured_min_temp": None if low is None else round(low, 2),
            "measured_max_temp": None if high is None else round(high, 2),
        }

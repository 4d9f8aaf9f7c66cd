"""[temperature_fan NAME]: a fan that holds a temperature down.

While its sensor is silent or out of range, or its measurements cannot be handled because of a bug, it runs at
its highest speed: the temperature is unknown.
"""

from collections.abc import Mapping
from typing import ClassVar, Final

from coordinator.config.options import ChoiceOption, FloatOption, SectionSpec
from coordinator.config.sections.heater_options import MAX_DELTA, PID_KD, PID_KI, PID_KP, SMOOTH_TIME
from coordinator.config.sections.sensor_options import (
    FREE_SENSOR_OPTIONS,
    SENSOR_OPTIONS,
    UNSUPPORTED_SENSOR_OPTIONS,
)
from coordinator.gcode.commands import Call, Reading, Synchronized
from coordinator.gcode.parameters import one, value
from coordinator.gcode.parser import WordError
from coordinator.heat.controller import Controller
from coordinator.heat.pid import Pid, PidGains
from coordinator.heat.watermark import Watermark
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.fans.fan_unit import (
    UNSUPPORTED_FAN_OPTIONS,
    FanModule,
    FanUnit,
    fan_options,
    shutdown_speed,
)
from coordinator.modules.heaters.heater import LOOK_S, SILENT_LOOKS
from coordinator.modules.heaters.heaters import HeaterRegistry
from coordinator.modules.sensors.free_temperatures import find_source
from coordinator.modules.sensors.temperature_sensor import GCODE_ID
from coordinator.runtime.module_context import ModuleContext
from coordinator.support.values import Value

FULL: Final = shutdown_speed(1.0)
TARGET_TEMP: Final = FloatOption(
    name="target_temp",
    help="temperature that it must not exceed; 0: the fan is off",
    default=40.0,
    unit="°C",
    minimum=0,
    maximum=1500,
)
MAX_SPEED: Final = FloatOption(name="max_speed", help="its highest speed", default=1.0, above=0, maximum=1)
MIN_SPEED: Final = FloatOption(
    name="min_speed", help="its lowest speed while it holds a temperature", default=0.3, minimum=0, maximum=1
)
CONTROL: Final = ChoiceOption(
    name="control",
    help="how its speed follows the temperature",
    choices=("pid", "watermark"),
    unsupported=("curve",),
)
MIRROR_C: Final = 5000.0
"""Controllers heat: temperatures are mirrored at this one for a fan, which cools."""


class TemperatureFans(Module):
    """The fans with a target."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.by_name: dict[str, TemperatureFan] = {}
        build.add_command(
            "SET_TEMPERATURE_FAN_TARGET",
            "Set the target of a temperature_fan: TEMPERATURE_FAN= TARGET= MIN_SPEED= MAX_SPEED=",
            self._set,
            while_printing=True,
        )

    def _set(self, call: Call) -> Reading:
        command = call.command
        given = call.parameters("TEMPERATURE_FAN", "TARGET", "MIN_SPEED", "MAX_SPEED")
        fan = self.by_name[one(command, given, "TEMPERATURE_FAN", self.by_name)]
        target = value(command, given, "TARGET", fan.usual_target_c)
        low = value(command, given, "MIN_SPEED", fan.min_speed)
        high = value(command, given, "MAX_SPEED", fan.max_speed)
        if target and not fan.input.min_c <= target <= fan.input.max_c:
            raise WordError(
                f"TARGET={target:g} is outside what [{fan.name}] allows, {fan.input.min_c:g} to"
                f" {fan.input.max_c:g} °C"
            )
        if not 0 <= low <= high <= 1:
            raise WordError("SET_TEMPERATURE_FAN_TARGET needs 0 <= MIN_SPEED <= MAX_SPEED <= 1")

        def act(_: float) -> None:
            fan.target_c, fan.min_speed, fan.max_speed = target, low, high

        return Synchronized(act)


class TemperatureFan(FanModule):
    """A fan that holds a temperature down."""

    NAMED: ClassVar = True
    SPEC: ClassVar = SectionSpec(
        help="A fan that keeps a temperature down, such as that of a board or a chamber",
        options=(
            *fan_options(FULL),
            *SENSOR_OPTIONS,
            *FREE_SENSOR_OPTIONS,
            TARGET_TEMP,
            MIN_SPEED,
            MAX_SPEED,
            CONTROL,
            PID_KP,
            PID_KI,
            PID_KD,
            SMOOTH_TIME,
            MAX_DELTA,
            GCODE_ID,
        ),
        unsupported=(*UNSUPPORTED_SENSOR_OPTIONS, *UNSUPPORTED_FAN_OPTIONS, "pid_deriv_time", "reverse"),
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.unit = FanUnit(build, FULL)
        self.input = find_source(build)
        self.input.on_measured = self._measured
        self.usual_target_c = self.target_c = build.get(TARGET_TEMP)
        self._silent = False
        self.min_speed, self.max_speed = build.get(MIN_SPEED), build.get(MAX_SPEED)
        if self.min_speed > self.max_speed:
            raise build.reader.bad(MIN_SPEED, f"more than max_speed ({self.max_speed:g})")
        self._controller = _controller(build)
        build.shared(HeaterRegistry).add_sensor(self.input, build.find(GCODE_ID) or "")
        build.shared(TemperatureFans).by_name[build.instance] = self

    def link(self, modules: Modules) -> None:
        """Find the sensor."""
        self.input.link(modules)

    async def connect(self, live: "ModuleContext") -> None:
        """Start acting."""
        await super().connect(live)
        await self.input.connect(live)
        live.every(LOOK_S, lambda: self._look(live))

    def end(self, cause: str) -> None:
        """Stop acting."""
        super().end(cause)
        self.input.end(cause)

    def _measured(self, at_s: float, celsius: float) -> None:
        if self.target_c <= 0:
            self.unit.set_speed(0.0)
            return
        if not self.input.is_sound:
            self.unit.set_speed(self.max_speed)
            return
        wanted = self._controller.power(at_s, MIRROR_C - celsius, MIRROR_C - self.target_c)
        self.unit.set_speed(min(max(wanted, self.min_speed), self.max_speed))

    def _look(self, live: "ModuleContext") -> None:
        """Check that there still are measurements."""
        if self.input.missed() <= SILENT_LOOKS:
            self._silent = False
            return
        self.unit.set_speed(self.max_speed if self.target_c > 0 else 0.0)
        if self._silent or self.target_c <= 0:
            return
        self._silent = True
        cure = f"check node {self.input.node} and its wires" if self.input.node else "find out why"
        what = "its sensor is silent"
        if self.input.unhandled:
            what, cure = "its measurements cannot be handled", "this is a bug, please report it"
        live.say(f"[{self.name}] runs at its highest speed: {what}; {cure}")

    @property
    def controls(self) -> bool:
        """Whether it has a target."""
        return self.target_c > 0

    def status(self) -> Mapping[str, Value]:
        """Report the fan and the temperature."""
        celsius = self.input.celsius
        return {
            **self.unit.status(),
            "temperature": None if celsius is None else round(celsius, 2),
            "target": self.target_c,
        }


def _controller(build: Build) -> Controller:
    delta, smooth = build.get(MAX_DELTA), build.get(SMOOTH_TIME)
    gains = [PID_KP, PID_KI, PID_KD]
    if build.get(CONTROL) == "watermark":
        for gain in gains:
            build.find(gain)
        return Watermark(max_delta_k=delta)
    return Pid(PidGains(*map(build.get, gains)), smooth_s=smooth)

"""[heater_fan NAME] and [controller_fan NAME]: fans that run while a heater is hot or motors are on."""

from typing import ClassVar, Final

from coordinator.config.options import FloatOption, IntOption, ListOption, SectionSpec
from coordinator.modules.base import Build, Modules
from coordinator.modules.drivers.motor_power import MotorPower
from coordinator.modules.fans.fan_unit import (
    UNSUPPORTED_FAN_OPTIONS,
    FanModule,
    FanUnit,
    fan_options,
    shutdown_speed,
)
from coordinator.modules.heaters.heater import Heater
from coordinator.modules.heaters.heaters import HeaterRegistry
from coordinator.runtime.module_context import ModuleContext

LOOK_S: Final = 1.0
FULL: Final = shutdown_speed(1.0)
OFF: Final = shutdown_speed(0.0)
HEATER: Final = ListOption(
    name="heater",
    help="the heaters that it cools; none: it never runs",
    default=("extruder",),
    may_be_empty=True,
)
HEATER_TEMP: Final = FloatOption(
    name="heater_temp",
    help="it runs while a heater is hotter than this, or has a target",
    default=50.0,
    unit="°C",
    minimum=0,
    maximum=1500,
)
FAN_SPEED: Final = FloatOption(
    name="fan_speed", help="its speed while it runs", default=1.0, minimum=0, maximum=1
)
IDLE_TIMEOUT: Final = IntOption(
    name="idle_timeout",
    help="how long it runs at idle_speed after steppers and heaters were switched off",
    default=30,
    unit="s",
    minimum=0,
    maximum=1_000_000_000,
)
IDLE_SPEED: Final = FloatOption(
    name="idle_speed", help="its speed then; by default fan_speed", minimum=0, maximum=1
)
STEPPER: Final = ListOption(
    name="stepper", help="the steppers it cools: it runs while one of them is on; by default all"
)
CONTROLLER_HEATER: Final = ListOption(
    name="heater", help="the heaters whose drivers it cools", default=("extruder",), may_be_empty=True
)


class _HeaterNames:
    """Finds the heaters that an option names."""

    def __init__(self, build: Build, option: ListOption) -> None:
        self._reader, self._option = build.reader, option
        self._names = build.get(option)
        self._given = build.reader.has(option)
        self._heaters = build.shared(HeaterRegistry)

    def find(self, modules: Modules) -> list[Heater]:
        """Return those that act; raises ConfigError. A default that does not exist is no mistake."""
        known = {name: unit for unit in self._heaters.units.values() for name in (unit.key, unit.name)}
        found = []
        for name in self._names:
            if name in known:
                found.append(known[name])
            elif self._given and not modules.is_left_out(name):
                raise self._reader.unknown(self._option, name, known)
        return found


class HeaterFan(FanModule):
    """A fan that runs while a heater is hot."""

    NAMED: ClassVar = True
    SPEC: ClassVar = SectionSpec(
        help="A fan that runs while a heater is hot or has a target, such as that of a hot end",
        options=(*fan_options(FULL), HEATER, HEATER_TEMP, FAN_SPEED),
        unsupported=UNSUPPORTED_FAN_OPTIONS,
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.unit = FanUnit(build, FULL)
        self._names = _HeaterNames(build, HEATER)
        if not build.get(HEATER):
            build.note(HEATER, "names no heater, so the fan never runs")
        self._hot_c = build.get(HEATER_TEMP)
        self._speed = build.get(FAN_SPEED)
        self._heaters: list[Heater] = []

    def link(self, modules: Modules) -> None:
        """Find its heaters."""
        self._heaters = self._names.find(modules)

    async def connect(self, live: "ModuleContext") -> None:
        """Start the periodic check."""
        await super().connect(live)
        live.every(LOOK_S, self._look)

    def _look(self) -> None:
        wanted = any(
            unit.target_c > 0 or (unit.input.sound_c is not None and unit.input.sound_c > self._hot_c)
            for unit in self._heaters
        )
        self.unit.set_speed(self._speed if wanted else 0.0)


class ControllerFan(FanModule):
    """A fan that cools a board while its motors or heaters are on."""

    NAMED: ClassVar = True
    SPEC: ClassVar = SectionSpec(
        help="A fan that runs while steppers are on or a heater has a target, and some time after; steppers"
        " without enable_pin are on while a job runs",
        options=(
            *fan_options(OFF),
            CONTROLLER_HEATER,
            STEPPER,
            FAN_SPEED,
            IDLE_TIMEOUT,
            IDLE_SPEED,
        ),
        unsupported=UNSUPPORTED_FAN_OPTIONS,
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.unit = FanUnit(build, OFF)
        self._names = _HeaterNames(build, CONTROLLER_HEATER)
        self._power = build.shared(MotorPower)
        self._steppers = self._read_steppers(build)
        self._speed = build.get(FAN_SPEED)
        idle = build.find(IDLE_SPEED)
        self._idle_speed = self._speed if idle is None else idle
        self._idle_s = build.get(IDLE_TIMEOUT)
        self._heaters: list[Heater] = []
        self._worked_s: float | None = None

    @staticmethod
    def _read_steppers(build: Build) -> tuple[str, ...]:
        known = [stepper.name for stepper in build.machine.steppers]
        given = build.find(STEPPER)
        for name in given or ():
            if name not in known:
                raise build.reader.unknown(STEPPER, name, known)
        return given or tuple(known)

    def link(self, modules: Modules) -> None:
        """Find its heaters."""
        self._heaters = self._names.find(modules)

    async def connect(self, live: "ModuleContext") -> None:
        """Start the periodic check."""
        await super().connect(live)
        live.every(LOOK_S, self._look)

    def _look(self) -> None:
        now_s = self.live.now_s()
        on = self._power.are_on()
        moves = any(on.get(name, self.live.machine.busy) for name in self._steppers)
        if moves or any(unit.target_c > 0 for unit in self._heaters):
            self._worked_s = now_s
            self.unit.set_speed(self._speed)
        elif self._worked_s is not None and now_s - self._worked_s < self._idle_s:
            self.unit.set_speed(self._idle_speed)
        else:
            self.unit.set_speed(0.0)

"""[fan], the part's fan, and [fan_generic NAME]."""

from typing import ClassVar, Final

from coordinator.config.options import SectionSpec
from coordinator.gcode.commands import Call, Reading, Synchronized
from coordinator.gcode.parameters import numbers, one, value
from coordinator.gcode.parser import WordError
from coordinator.modules.base import Build, Module
from coordinator.modules.fans.fan_unit import (
    UNSUPPORTED_FAN_OPTIONS,
    FanModule,
    FanUnit,
    fan_options,
    shutdown_speed,
)

OFF: Final = shutdown_speed(0.0)
FULL: Final = 255.0
"""The S of M106 for full speed."""


class Fan(FanModule):
    """The fan that cools the part."""

    SPEC: ClassVar = SectionSpec(
        help="The fan that cools the part: M106, M107",
        options=fan_options(OFF),
        unsupported=UNSUPPORTED_FAN_OPTIONS,
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.unit = FanUnit(build, OFF)
        build.add_command("M106", "Set the part's fan: S, 0 to 255", self._set, while_printing=True)
        build.add_command("M107", "Stop the part's fan", self._stop, while_printing=True)

    def _set(self, call: Call) -> Reading:
        words = numbers(call.command, "SP")
        speed = words.get("S", FULL)
        if speed < 0:
            raise WordError(f"S of M106 is {speed:g}; it must be 0 to 255")
        return self._at(speed / FULL)

    def _stop(self, call: Call) -> Reading:
        numbers(call.command, "P")
        return self._at(0.0)

    def _at(self, speed: float) -> Synchronized:
        return Synchronized(lambda print_time_s: self.unit.set_speed(speed, print_time_s))


class GenericFans(Module):
    """The fans that programs set by their names."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.units: dict[str, FanUnit] = {}
        build.add_command(
            "SET_FAN_SPEED",
            "Set the speed of a fan_generic: FAN= SPEED=, 0 to 1",
            self._set,
            while_printing=True,
        )

    def _set(self, call: Call) -> Reading:
        given = call.parameters("FAN", "SPEED")
        unit = self.units[one(call.command, given, "FAN", self.units)]
        speed = value(call.command, given, "SPEED", 0.0)
        if not 0 <= speed <= 1:
            raise WordError(f"SPEED={speed:g} of SET_FAN_SPEED must be 0 to 1")
        return Synchronized(lambda print_time_s: unit.set_speed(speed, print_time_s))


class FanGeneric(FanModule):
    """A fan that programs set by its name."""

    NAMED: ClassVar = True
    SPEC: ClassVar = SectionSpec(
        help="A fan that programs set: SET_FAN_SPEED FAN=NAME SPEED=",
        options=fan_options(OFF),
        unsupported=UNSUPPORTED_FAN_OPTIONS,
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.unit = FanUnit(build, OFF)
        build.shared(GenericFans).units[build.instance] = self.unit

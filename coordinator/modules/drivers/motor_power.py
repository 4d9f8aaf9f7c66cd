"""Enable pins: a driver is switched on before its motor moves, and all are switched off by M84.

SET_STEPPER_ENABLE is for tests: it switches one driver, and those that share its pin.
"""

import asyncio
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Final

from coordinator.config.pins import PinDescription
from coordinator.gcode.commands import AtStandstill, Call, Immediate, Reading
from coordinator.gcode.events import Done
from coordinator.gcode.parameters import flag, one
from coordinator.modules.base import Build, Module
from coordinator.support.values import Value
from nodes.devices.digital_out import DigitalOut
from nodes.node.node import Node

WAKE_S: Final = 0.1
"""Drivers need this long after they were switched on or off."""


class EnableLine(DigitalOut):
    """One enable pin, for all motors that share it."""

    def __init__(self, pin: "PinDescription") -> None:
        super().__init__(f"the drivers on {pin.node}:{pin.name}", pin=pin.name, invert=pin.invert)
        self.node = pin.node
        self.steppers: list[str] = []
        self.on = False

    def started(self, node: "Node") -> None:
        """Record that the drivers are off, as configured."""
        super().started(node)
        self.on = False


class MotorPower(Module):
    """The enable pins of a machine's steppers."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.name = "stepper_enable"
        lines: dict[tuple[str, str], EnableLine] = {}
        for stepper in build.machine.steppers:
            pin = stepper.enable_pin
            if pin is not None:
                line = lines.setdefault((pin.node, pin.name), EnableLine(pin))
                line.steppers.append(stepper.name)
        self._lines = tuple(lines.values())
        self._motors = build.machine.motors
        self.when_off: list[Callable[[Collection[str]], None]] = []
        """Called with the names of motors that are switched off by a command."""
        for line in self._lines:
            build.add_device(line.node, line)
        for name in ("M84", "M18"):
            build.add_command(name, "Switch all motors off; no axis is homed then", self._read_off)
        build.add_command("M17", "Switch all motors on", self._read_on)
        build.add_command(
            "SET_STEPPER_ENABLE", "Switch the motor STEPPER on or off (ENABLE=1, 0)", self._read_one
        )

    def stopped(self, cause: str) -> None:
        """Record that the nodes have switched all drivers off."""
        del cause
        for line in self._lines:
            line.on = False

    def status(self) -> dict[str, Value]:
        """Report which motors are on."""
        return {"steppers": dict(self.are_on())}

    def are_on(self) -> "Mapping[str, bool]":
        """Report which motors are on, of those with an enable pin."""
        return {name: line.on for line in self._lines for name in line.steppers}

    def on(self, steppers: "Collection[str]") -> None:
        """Switch those of STEPPERS on that are off, as soon as possible; steps may follow WAKE_S later."""
        for line in self._lines:
            if not line.on and any(name in steppers for name in line.steppers):
                self._switch(line, on=True)

    def _switch(self, line: EnableLine, *, on: bool) -> None:
        live = self._live
        if live is None or not live.node(line.node).talks:
            return
        # Not at a time: a busy host might miss it, and nothing needs more than the order of the commands.
        line.set_now(live.node(line.node), on)
        line.on = on

    # --------------------------------------------------------------------------------------------- commands

    def _read_off(self, call: Call) -> Reading:
        call.command.words()  # slicers name axes, which means nothing: the motors go off together
        if not self._lines:
            return Immediate()
        return AtStandstill(lambda: self._all(on=False), Done(unhomed="XYZ"))

    def _read_on(self, call: Call) -> Reading:
        call.command.words()
        return AtStandstill(lambda: self._all(on=True))

    def _read_one(self, call: Call) -> Reading:
        values = call.parameters("STEPPER", "ENABLE")
        name = one(call.command, values, "STEPPER", self.are_on())
        enable = flag(call.command, {"ENABLE": "1", **values}, "ENABLE")
        lines = [line for line in self._lines if name in line.steppers]
        done = Done(unhomed="" if enable else self._moved_by(lines))
        return AtStandstill(lambda: self._some(lines, enable, done), done)

    def _moved_by(self, lines: "Iterable[EnableLine]") -> str:
        """Return the letters of the axes whose place is not sure when the motors of LINES are off."""
        names = {name for line in lines for name in line.steppers}
        letters = set()
        for motor in self._motors:
            if motor.name in names:
                own = {axis for axis, weight in zip("XYZ", motor.weights, strict=False) if weight}
                letters |= own or set("XYZ")
        return "".join(sorted(letters))

    async def _all(self, *, on: bool) -> Done:
        return await self._some(self._lines, on, Done(unhomed="" if on else "XYZ"))

    async def _some(self, lines: "Iterable[EnableLine]", on: bool, done: Done) -> Done:
        for line in lines:
            self._switch(line, on=on)
            for call in self.when_off if not on else ():
                call(line.steppers)
        await asyncio.sleep(2 * WAKE_S)
        return done

"""What all heaters and sensors have in common: their names, and the commands for any of them."""

from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from math import isinf
from typing import Final

from coordinator.gcode.commands import AtStandstill, Call, Immediate, Reading, Synchronized
from coordinator.gcode.events import Done
from coordinator.gcode.parameters import numbers, one, value
from coordinator.gcode.parser import WordError
from coordinator.gcode.reply_kinds import ReplyKind
from coordinator.modules.base import Build, Module
from coordinator.modules.heaters.heater import Heater
from coordinator.modules.heaters.tuning import calibrate_mpc, calibrate_pid
from coordinator.modules.sensors.temperature_source import TemperatureSource
from coordinator.support.values import Value

FAN_STEPS_MAX: Final = 12


class HeaterRegistry(Module):
    """The heaters and temperature sensors of the machine, and the commands for any of them."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.name = "heaters"
        self.units: dict[str, Heater] = {}
        """By the name in programs: extruder, heater_bed, NAME of heater_generic."""
        self.sensors: dict[str, TemperatureSource] = {}
        """By the name in programs: heaters and the sections of sensors."""
        self._tags: dict[str, Heater | TemperatureSource] = {}
        self._interrupts = 0
        """How often a wait for a temperature was to end."""
        self._waiting_for: Value = None
        for name, help_, read in (
            ("M105", "Report all temperatures", self._report),
            ("TURN_OFF_HEATERS", "Turn all heaters off", self._turn_off),
            ("SET_HEATER_TEMPERATURE", "Set a heater's target: HEATER= TARGET=", self._set),
            ("HEATER_INTERRUPT", "End the TEMPERATURE_WAIT that waits", self._interrupt),
        ):
            build.add_command(name, help_, read, while_printing=True)
        for name, help_, read in (
            (
                "TEMPERATURE_WAIT",
                "Wait until a temperature is in a range: SENSOR= MINIMUM= MAXIMUM=",
                self._wait,
            ),
            ("QUERY_ADC", "Report what a sensor's converter reads: NAME= PULLUP=", self._query),
            ("PID_CALIBRATE", "Calibrate a heater's PID constants: HEATER= TARGET=", self._pid),
            (
                "MPC_CALIBRATE",
                "Calibrate a heater's model: HEATER= TARGET= FAN_BREAKPOINTS=",
                self._mpc,
            ),
        ):
            build.add_command(name, help_, read)

    @property
    def controls(self) -> bool:
        """Whether a heater is on."""
        return any(unit.controls for unit in self.units.values())

    @property
    def changes(self) -> int:
        """How often a heater was given another target."""
        return sum(unit.changes for unit in self.units.values())

    @property
    def targets(self) -> dict[str, float]:
        """The targets of the heaters that have one, °C, by their names."""
        return {name: unit.target_c for name, unit in self.units.items() if unit.target_c > 0}

    def turn_off(self) -> None:
        """Turn all heaters off; on the control loop."""
        for unit in self.units.values():
            unit.set_target(0.0)

    def add(self, unit: Heater, tag: str = "") -> None:
        """Register a heater; TAG is its name in M105."""
        self.units[unit.key] = unit
        self.sensors[unit.key] = unit.input
        if unit.name != unit.key:
            self.sensors[unit.name] = unit.input
        self._tags[tag or unit.key] = unit

    def add_sensor(self, source: TemperatureSource, tag: str = "") -> None:
        """Register a sensor that belongs to no heater; TAG is its name in M105."""
        self.sensors[source.name] = source
        if tag:
            self._tags[tag] = source

    def status(self) -> Mapping[str, Value]:
        """Report what there is."""
        calibrated: dict[str, Value] = {
            unit.name: dict(unit.calibrated) for unit in self.units.values() if unit.calibrated
        }
        return {
            "available_heaters": list(self.units),
            "available_sensors": list(self.sensors),
            "available_monitors": [],
            "calibrated": calibrated,
            "waiting_for": self._waiting_for,
        }

    @contextmanager
    def _waits(self, name: str, low_c: float, high_c: float) -> Iterator[None]:
        """Report, inside the block, that a command waits for NAME to be between LOW_C and HIGH_C."""
        limits: dict[str, Value] = {
            "minimum": None if isinf(low_c) else low_c,
            "maximum": None if isinf(high_c) else high_c,
        }
        self._waiting_for = {"name": name, **limits}
        try:
            yield
        finally:
            self._waiting_for = None

    # ------------------------------------------------------------------------------------------ commands

    def temperatures(self) -> str:
        """Return all temperatures as hosts expect them: ``B:60.0 /60.0 T0:200.1 /200.0``."""
        parts = []
        for tag in sorted(self._tags):
            found = self._tags[tag]
            source = found.input if isinstance(found, Heater) else found
            celsius = 0.0 if source.celsius is None else source.celsius
            target = found.target_c if isinstance(found, Heater) else 0.0
            parts.append(f"{tag}:{celsius:.1f} /{target:.1f}")
        return " ".join(parts) or "T:0"

    def set_target(self, unit: Heater, celsius: float) -> Synchronized:
        """Return what sets a target without waiting; WordError for one it cannot have."""
        unit.check_target(celsius)
        return Synchronized(lambda _: unit.set_target(celsius))

    def set_and_wait(self, unit: Heater, celsius: float) -> AtStandstill:
        """Return what sets a target and waits for it; WordError for one it cannot have."""
        unit.check_target(celsius)

        async def perform() -> Done | None:
            unit.set_target(celsius)
            if celsius > 0:
                with self._waits(unit.key, celsius, celsius):
                    await unit.reach()
            return Done((self.temperatures(),), kind=ReplyKind.PLAIN)

        return AtStandstill(perform)

    def _report(self, call: Call) -> Reading:
        numbers(call.command, "T")
        return Immediate((self.temperatures(),), kind=ReplyKind.PLAIN)

    def _turn_off(self, call: Call) -> Reading:
        call.parameters()
        return Synchronized(lambda _: self.turn_off())

    def _unit(self, call: Call, given: Mapping[str, str]) -> Heater:
        names = {name: unit for unit in self.units.values() for name in (unit.key, unit.name)}
        return names[one(call.command, given, "HEATER", names)]

    def _set(self, call: Call) -> Reading:
        given = call.parameters("HEATER", "TARGET")
        return self.set_target(self._unit(call, given), value(call.command, given, "TARGET", 0.0))

    def _wait(self, call: Call) -> Reading:
        command = call.command
        given = call.parameters("SENSOR", "MINIMUM", "MAXIMUM")
        source = self.sensors[one(command, given, "SENSOR", self.sensors)]
        if not given.keys() & {"MINIMUM", "MAXIMUM"}:
            raise WordError("TEMPERATURE_WAIT needs MINIMUM= or MAXIMUM=, or both")
        low = value(command, given, "MINIMUM", float("-inf"))
        high = value(command, given, "MAXIMUM", float("inf"))
        if low > high:
            raise WordError(f"TEMPERATURE_WAIT: MINIMUM={low:g} is above MAXIMUM={high:g}")
        if low >= source.max_c or high <= source.min_c:
            raise WordError(
                f"TEMPERATURE_WAIT waits for what [{source.name}] never reads: it takes"
                f" {source.min_c:g} to {source.max_c:g} °C"
            )

        async def perform() -> None:
            before = self._interrupts
            with self._waits(given["SENSOR"], low, high):
                await source.next()
                while source.celsius is None or not (source.is_sound and low <= source.celsius <= high):
                    if self._interrupts != before:
                        return
                    await source.next()

        return AtStandstill(perform)

    def _interrupt(self, call: Call) -> Reading:
        call.parameters()

        def act(_: float) -> None:
            self._interrupts += 1

        return Synchronized(act)

    def _query(self, call: Call) -> Reading:
        given = call.parameters("NAME", "PULLUP")
        names = [name for name, source in self.sensors.items() if source.ratio is not None]
        if "NAME" not in given:
            return Immediate(
                (f"sensors with a converter: {', '.join(names) or 'none has read anything yet'}",)
            )
        name = one(call.command, given, "NAME", names)
        ratio = self.sensors[name].ratio or 0.0
        text = f"{name}: {ratio:.6f} of full scale"
        if "PULLUP" in given:
            ohms = value(call.command, given, "PULLUP")
            below = f"{ohms * ratio / (1 - ratio):.1f} Ω" if ratio < 1 else "no resistor"
            text += f", with {ohms:g} Ω above it {below}"
        return Immediate((text,))

    def _pid(self, call: Call) -> Reading:
        given = call.parameters("HEATER", "TARGET", "WRITE_FILE", "TOLERANCE")
        unit, target = self._unit(call, given), value(call.command, given, "TARGET")
        return self._calibration(unit, target, lambda: calibrate_pid(unit, target))

    def _mpc(self, call: Call) -> Reading:
        given = call.parameters("HEATER", "TARGET", "FAN_BREAKPOINTS")
        unit, target = self._unit(call, given), value(call.command, given, "TARGET", 200.0)
        steps = round(value(call.command, given, "FAN_BREAKPOINTS", 3.0))
        if not 2 <= steps <= FAN_STEPS_MAX:
            raise WordError(f"FAN_BREAKPOINTS of MPC_CALIBRATE must be 2 to {FAN_STEPS_MAX}")
        if unit.settings.heater_w is None:
            raise WordError(f"MPC_CALIBRATE needs the option heater_power of [{unit.name}], in W")
        return self._calibration(unit, target, lambda: calibrate_mpc(unit, target, steps))

    @staticmethod
    def _calibration(unit: Heater, target: float, run: Callable[[], Awaitable[Done]]) -> Reading:
        if not unit.input.min_c < target <= unit.input.max_c:
            raise WordError(
                f"TARGET={target:g} is outside what [{unit.name}] allows, {unit.input.min_c:g} to"
                f" {unit.input.max_c:g} °C"
            )
        return AtStandstill(run)

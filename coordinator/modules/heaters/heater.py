"""One heater: sensor, controller, output, and the checks of them.

Three independent safety nets: the controller and the heater check here; the node's own limits of what its
sensor may read; and the node's max_duration, within which it has to hear from the host.
The host renews the output with every measurement and with nothing else: no measurements, no heat, nor with
such as cannot be handled because of a bug. Without them it ends the heat a moment before the node would have
to stop, since the node may have other tasks.
"""

import asyncio
import contextlib
import math
from collections.abc import Callable, Mapping
from typing import Final, Protocol

from coordinator.config.sections.heater_options import (
    AMBIENT_SENSOR,
    COOLING_FAN,
    CYCLE_TIME,
    HEATER_PIN,
    MAX_DURATION,
)
from coordinator.gcode.parser import WordError
from coordinator.heat.controller import Controller
from coordinator.heat.holding import Held, Holding
from coordinator.heat.mpc import Mpc
from coordinator.heat.verify import HeaterCheck, VerifyOptions, default_options
from coordinator.modules.base import Build, Modules
from coordinator.modules.fans.fan_unit import FanModule
from coordinator.modules.heaters.control import ControlSettings
from coordinator.modules.outputs.timing import AHEAD_S
from coordinator.modules.sensors.temperature_input import SensorModule, TemperatureInput
from coordinator.runtime.module_context import ModuleContext
from coordinator.support.values import Value
from nodes.devices.analog_in import RANGE_CHECKS
from nodes.devices.pwm_out import PwmOut
from nodes.node.states import NodeState
from nodes.support.errors import CanductorError

LOOK_S: Final = 1.0
"""How often it is checked that there still are measurements."""
SILENT_LOOKS: Final = 2
"""How many checks in a row may find none; not a time, as the host itself may have been suspended."""

STALE_SPARE_S: Final = 0.15
"""How long before the node would stop it a power is switched off that no measurement has renewed."""
STALE_EARLY_S: Final = 0.3
"""So much earlier that is checked when the computer is awake anyway: with the usual max_duration for the
third measurement from now on."""
STALE_AGAIN_S: Final = 0.01
"""Least time until the next check of that."""

COOLS_WITHIN_S: Final = 300.0
COOLS_BY_C: Final = 0.2
"""A heater without power that gets no cooler than this in that time is as warm as the room."""

COMING_S: Final = 1.0
"""How far ahead filament that is going to pass is taken into account, from when a power acts."""
BAD_MEASUREMENTS: Final = RANGE_CHECKS + 2
"""After this many out of range the node should have stopped by itself."""


class Tuning(Protocol):
    """A controller that measures its heater."""

    @property
    def watched_c(self) -> float: ...  # noqa: D102
    def power(self, now_s: float, measured_c: float, target_c: float = ..., /) -> float: ...  # noqa: D102
    @property
    def is_done(self) -> bool: ...  # noqa: D102


class Heater:
    """The heater of section BUILD, which programs call KEY."""

    def __init__(self, build: Build, key: str) -> None:
        self.key = key
        self.name = build.name
        pin = build.pin(HEATER_PIN)
        self.input = TemperatureInput(build)
        self.input.on_measured = self._measured
        self.settings = ControlSettings(build)
        self.target_c = 0.0
        self.changes = 0
        """How often it was given another target."""
        self.power = 0.0
        """What is applied now, 0..1."""
        self.controller: Controller | None = self.settings.controller()
        self.node = pin.node
        self._output = PwmOut(
            f"the heater of [{build.name}]",
            pin=pin.name,
            cycle_s=build.get(CYCLE_TIME),
            invert=pin.invert,
            # Counted from when a value takes effect, which is so long after it was sent.
            max_duration_s=build.get(MAX_DURATION) - AHEAD_S,
        )
        build.add_device(pin.node, self._output, pin)
        self._find_fan = build.needed(COOLING_FAN, FanModule) if build.find(COOLING_FAN) else None
        ambient = build.find(AMBIENT_SENSOR)
        self._find_ambient = build.needed(AMBIENT_SENSOR, SensorModule) if ambient else None
        self.fan: FanModule | None = None
        """What cools it, where the section says so."""
        self._ambient: SensorModule | None = None
        self.calibrated: dict[str, str] = {}
        """Options of the section and their values, as calibration found them."""
        self._check = HeaterCheck(default_options(key))
        self._holding = Holding()
        self.on_held: Callable[[Held], None] | None = None
        """Called at the end of each steady state."""
        self._tuning: Tuning | None = None
        self._tuning_failure: CanductorError | None = None
        self._live: ModuleContext | None = None
        self._on = False
        self._applied_s = 0.0
        """When power was applied last, host's time."""
        self._stale_s = build.get(MAX_DURATION) - AHEAD_S - STALE_SPARE_S
        self._stale_check: Callable[[], None] | None = None
        """Cancels the check that waits for the moment at which the power is too old."""
        self._off_because: str | None = None
        """Why the target was cleared; None: it was not."""
        self._bad = 0
        self._reported_s = 0.0

    # ---------------------------------------------------------------------------------------------- life

    def link(self, modules: Modules) -> None:
        """Find what belongs to it; raises ConfigError."""
        self.input.link(modules)
        if self._find_fan is not None:
            self.fan = self._find_fan(modules)
        if self._find_ambient is not None:
            self._ambient = self._find_ambient(modules)

    def watch(self, options: VerifyOptions) -> None:
        """Use OPTIONS for the check that the heater heats; before ``connect``."""
        self._check = HeaterCheck(options)

    async def connect(self, live: "ModuleContext") -> None:
        """Start acting."""
        self._live = live
        if self.settings.kind == "mpc":
            live.machine.filament.want(self.name)
        await self.input.connect(live)
        live.every(LOOK_S, self._look)

    def keep(self, found: dict[str, str]) -> None:
        """Save what calibration FOUND with the next SAVE_CONFIG: options of the section and their values."""
        self.calibrated = found
        if self._live is not None:
            for option, text in found.items():
                self._live.save(self.name, option, text)

    def end(self, cause: str) -> None:
        """Stop acting, and switch off; when the machine was stopped, the nodes have done that."""
        if self._on and self._live is not None and self._live.machine.stopped is None:
            self._turn_off(self._live)
        self._on = False
        self._live = self._stale_check = None
        self.target_c = self.power = 0.0
        self._report_held(self._holding.end())
        self.input.end(cause)

    def status(self) -> Mapping[str, Value]:
        """Report how it is."""
        status: dict[str, Value] = {
            "temperature": _rounded(self.input.celsius),
            "target": self.target_c,
            "power": round(self.power, 4),
            **_band(self._holding.held),
        }
        if isinstance(self.controller, Mpc):
            status["control_stats"] = {
                "temp_block": _rounded(self.controller.block_c),
                "temp_sensor": _rounded(self.controller.sensor_c),
                "temp_ambient": _rounded(self.controller.ambient_c),
                "filament_mm_per_s": round(self.controller.filament_mm_per_s, 2),
            }
        return status

    # ------------------------------------------------------------------------------------------- targets

    def check_target(self, celsius: float) -> None:
        """Raise WordError unless CELSIUS is a target it may have, or 0 for off."""
        if celsius and not self.input.min_c <= celsius <= self.input.max_c:
            raise WordError(
                f"{celsius:g} °C is outside what [{self.name}] allows, {self.input.min_c:g} to"
                f" {self.input.max_c:g} °C; correct the program, or min_temp and max_temp"
            )
        if celsius and self.controller is None:
            raise WordError(
                f"[{self.name}] has to be calibrated before it heats: MPC_CALIBRATE HEATER={self.key}"
            )

    def set_target(self, celsius: float) -> None:
        """Heat to CELSIUS, 0: not at all. Off at once, on with the next measurement.

        A calibration ends when its heater is switched off.
        """
        self.changes += celsius != self.target_c
        self.target_c, self._off_because = celsius, None
        if celsius <= 0:
            if self._tuning is not None:
                self._end_tuning("it was switched off")
            self._apply(0.0)

    @property
    def controls(self) -> bool:
        """Whether it has a target, or is calibrated."""
        return self.target_c > 0 or self._tuning is not None

    @property
    def settled(self) -> bool:
        """Whether a command that waits for the target may go on."""
        if self.target_c <= 0 or self.controller is None or self.input.celsius is None:
            return True
        return self.input.is_sound and self.controller.settled(self.input.celsius, self.target_c)

    async def reach(self) -> None:
        """Wait until the target is reached; raises CanductorError when the heater ends before.

        So it does when nothing cools it down to its target.
        """
        await self._next()  # with the target in force
        loop = asyncio.get_running_loop()
        coolest_c, since_s = math.inf, loop.time()
        while not self.settled:
            celsius = self.input.celsius or 0.0
            if celsius <= self.target_c or self.power > 0 or celsius < coolest_c - COOLS_BY_C:
                coolest_c, since_s = celsius, loop.time()
            elif loop.time() - since_s > COOLS_WITHIN_S:
                raise CanductorError(
                    f"[{self.name}] stays at {celsius:.1f} °C without power, above its target of"
                    f" {self.target_c:g} °C: nothing cools it further; use a target above that of the room"
                )
            await self._next()

    async def _next(self) -> None:
        """Wait for the next measurement; raises CanductorError when the heater was switched off meanwhile."""
        await self.input.next()
        if self._off_because is not None:
            raise CanductorError(self._off_because)

    async def tune(self, tuning: Tuning, each: Callable[[], None] = lambda: None) -> None:
        """Control the heater by TUNING until that is done, then switch it off.

        EACH is called after every measurement.
        """
        if self._tuning is not None:
            raise CanductorError(f"[{self.name}] is being calibrated already; wait for its end")
        self._tuning, self._tuning_failure, self._off_because = tuning, None, None
        try:
            while not tuning.is_done:
                await self._next()
                each()
                if self._tuning_failure is not None:
                    raise self._tuning_failure
        finally:
            self._tuning = self._tuning_failure = None
            self.set_target(0.0)

    def _end_tuning(self, why: str) -> None:
        """End the calibration with an error, and switch off."""
        self._tuning_failure = CanductorError(f"the calibration of [{self.name}] ended: {why}")
        self.input.wake()

    def use(self, controller: Controller) -> None:
        """Use another controller from now on."""
        self.controller = controller

    # ------------------------------------------------------------------------------------------- control

    def _measured(self, at_s: float, celsius: float) -> None:
        live = self._live
        if live is None:
            return
        if not self.input.min_c <= celsius <= self.input.max_c:
            self._out_of_range(live, celsius)
            return
        self._bad = 0
        watched_c = self.target_c if self._tuning is None else self._tuning.watched_c
        fault = self._check.check(at_s, celsius, watched_c, self.power)
        if fault is not None:
            live.stop(f"heater {self.key} {fault}")
            return
        self._apply(self._wanted(live, at_s, celsius))
        ended = self._holding.measured(at_s, celsius, self.target_c, self.power, settled=self.settled)
        if ended is not None:
            self._report_held(ended)

    def _report_held(self, held: Held | None) -> None:
        if held is not None and self.on_held is not None:
            self.on_held(held)

    def _out_of_range(self, live: "ModuleContext", celsius: float) -> None:
        """Switch off while the measurement is out of range; its node stops by itself a moment later."""
        self._bad += 1
        self._apply(0.0)
        if self._bad > BAD_MEASUREMENTS:
            live.stop(
                f"heater {self.key}: its sensor reads {celsius:.0f} °C, outside {self.input.min_c:g} to"
                f" {self.input.max_c:g} °C; check the sensor and its wires"
            )

    def _wanted(self, live: "ModuleContext", at_s: float, celsius: float) -> float:
        if self._off_because is not None or self._tuning_failure is not None:
            return 0.0
        if self._tuning is not None:
            try:
                return self._tuning.power(at_s, celsius)
            except CanductorError as error:
                self._tuning_failure = error
                return 0.0
        if self.controller is None:
            return 0.0
        if isinstance(self.controller, Mpc):
            self._update_model(live, self.controller, at_s)
        return self.controller.power(at_s, celsius, self.target_c)

    def _update_model(self, live: "ModuleContext", model: Mpc, at_s: float) -> None:
        if self.fan is not None:
            model.set_fan(self.fan.unit.speed)
        if self._ambient is not None and self._ambient.input.celsius is not None:
            model.set_ambient(self._ambient.input.celsius)
        if model.model.filament_j_per_mm_k > 0:
            forecast = live.machine.filament
            acts_s = at_s + AHEAD_S
            model.set_filament(
                forecast.mm_per_s(self.name, self._reported_s, at_s),
                forecast.mm_per_s(self.name, acts_s, acts_s + COMING_S),
            )
            self._reported_s = at_s

    def _apply(self, power: float) -> None:
        """Set POWER on the node; off needs no renewal."""
        live, self.power = self._live, power
        if live is None or (power <= 0 and not self._on):
            return
        try:
            self._output.set(live.node(self.node), live.ticks_in(self.node, AHEAD_S), power)
        except CanductorError as error:
            self._switch_off(str(error))
            return
        self._on, self._applied_s = power > 0, live.now_s()
        if self._on and self._stale_check is None:
            self._check_stale_in(live, self._stale_s)

    def _check_stale_in(self, live: "ModuleContext", left_s: float) -> None:
        early_s = max(left_s - STALE_EARLY_S, STALE_AGAIN_S)
        self._stale_check = live.after(early_s, self._end_stale_heat, most_s=left_s)

    def _end_stale_heat(self) -> None:
        """Switch off when no measurement has renewed the power for too long: the temperature is unknown."""
        live, self._stale_check = self._live, None
        if live is None or not self._on:
            return
        left_s = self._stale_s - (live.now_s() - self._applied_s)
        if left_s < 0:
            self._apply(0.0)
        else:  # it was renewed since, or this comes early
            self._check_stale_in(live, left_s)

    def _look(self) -> None:
        """Check that there still are measurements; stop the machine, or switch off, if there are none."""
        live = self._live
        if live is None or not self.controls:
            return
        for name in (self.input.node, self.node):
            if live.node(name).state is not NodeState.READY:
                self._switch_off(f"node {name} is {live.node(name).state.value}")
                return
        missed = self.input.missed()
        if missed > SILENT_LOOKS:
            what, cure = "its sensor has been silent", f"check node {self.input.node} and its wires"
            if self.input.unhandled:
                what, cure = "no measurement could be handled", "this is a bug, please report it"
            live.stop(f"heater {self.key}: {what} for about {missed * LOOK_S:g} s; {cure}")

    def _turn_off(self, live: "ModuleContext") -> None:
        if live.node(self.node).state is NodeState.READY:
            with contextlib.suppress(CanductorError):  # then its own max_duration ends it
                self._output.set(live.node(self.node), live.ticks_in(self.node, AHEAD_S), 0.0)

    def _switch_off(self, why: str) -> None:
        """Clear the target: the node of the heater or of its sensor, which may be absent, is gone."""
        live, was, on = self._live, self.target_c, self._on
        self.target_c, self.power, self._on = 0.0, 0.0, False
        self._off_because = f"heater {self.key} was turned off: {why}"
        if on and live is not None:
            self._turn_off(live)
        self.input.wake()
        if was > 0 and live is not None:
            live.say(f"heater {self.key} was turned off; its target ({was:g} °C) was cleared: {why}")


def _band(held: Held | None) -> dict[str, Value]:
    return {
        "held_s": None if held is None else round(held.seconds, 1),
        "held_low": None if held is None else round(held.low_c, 2),
        "held_high": None if held is None else round(held.high_c, 2),
    }


def _rounded(celsius: float | None) -> Value:
    return None if celsius is None else round(celsius, 2)

"""A fan: its output, what starts it, and its tachometer, for whatever module has one."""

from collections.abc import Mapping
from typing import Any, Final

from coordinator.config.options import BoolOption, FloatOption, IntOption, Option
from coordinator.config.pins import PinOption
from coordinator.modules.base import Build, Module
from coordinator.modules.outputs.timing import AHEAD_S, pwm_cycle
from coordinator.runtime.module_context import ModuleContext
from coordinator.support.values import Value
from nodes.devices.counter import Counter
from nodes.devices.digital_out import DigitalOut
from nodes.devices.pwm_out import PwmOut
from nodes.node.config import NodeConfig
from nodes.node.node import Node
from nodes.support.errors import CanductorError

PIN: Final = PinOption(name="pin", help="output that drives the fan")
MAX_POWER: Final = FloatOption(
    name="max_power", help="share of full power at speed 1", default=1.0, above=0, maximum=1
)
CYCLE_TIME: Final = FloatOption(
    name="cycle_time",
    help="period of its PWM",
    default=0.01,
    unit="s",
    minimum=1e-6,
    maximum=5,
)
HARDWARE_PWM: Final = BoolOption(
    name="hardware_pwm", help="use the node's PWM hardware, where the pin has it", default=False
)
KICK_START_TIME: Final = FloatOption(
    name="kick_start_time",
    help="how long it runs at full power when it starts, or speeds up a lot",
    default=0.1,
    unit="s",
    minimum=0,
    maximum=10,
)
OFF_BELOW: Final = FloatOption(
    name="off_below", help="speeds below this switch it off", default=0.0, minimum=0, maximum=1
)
ENABLE_PIN: Final = PinOption(name="enable_pin", help="output that is on while the fan runs")
TACHOMETER_PIN: Final = PinOption(
    name="tachometer_pin", help="input of the fan's tachometer", invertible=False, pullable=True
)
TACHOMETER_PPR: Final = IntOption(
    name="tachometer_ppr", help="pulses of the tachometer per turn", default=2, minimum=1, maximum=1000
)
TACHOMETER_POLL: Final = FloatOption(
    name="tachometer_poll_interval",
    help="how often the tachometer is read; below 30 / (tachometer_ppr · turns per minute)",
    default=0.0015,
    unit="s",
    minimum=0.0001,
    maximum=1,
)


def shutdown_speed(default: float) -> FloatOption:
    """Return the option for the speed a fan takes when its node stops."""
    return FloatOption(
        name="shutdown_speed",
        help="speed when the node stops for safety; without hardware_pwm 0 or 1",
        default=default,
        minimum=0,
        maximum=1,
    )


def fan_options(shutdown: FloatOption) -> tuple[Option[Any], ...]:
    """Return all options of a fan's output."""
    return (
        PIN,
        MAX_POWER,
        shutdown,
        CYCLE_TIME,
        HARDWARE_PWM,
        KICK_START_TIME,
        OFF_BELOW,
        ENABLE_PIN,
        TACHOMETER_PIN,
        TACHOMETER_PPR,
        TACHOMETER_POLL,
    )


UNSUPPORTED_FAN_OPTIONS: Final = ("min_power", "initial_speed")
TACHOMETER_S: Final = 1.0
"""How often the tachometer's count is reported."""
MUCH_FASTER: Final = 0.5


class FanUnit:
    """The fan of section BUILD."""

    def __init__(self, build: Build, shutdown: FloatOption) -> None:
        self.name = build.name
        self.speed = 0.0
        """0..1, as it was set last."""
        self.rpm: float | None = None
        """Turns per minute, where there is a tachometer that has reported."""
        self._max_power = build.get(MAX_POWER)
        self._kick_s = build.get(KICK_START_TIME)
        self._off_below = build.get(OFF_BELOW)
        pin = build.pin(PIN)
        self.node = pin.node
        hardware, stopped = build.get(HARDWARE_PWM), build.get(shutdown)
        cycle_s = pwm_cycle(build, CYCLE_TIME, hardware=hardware)
        self._output = PwmOut(
            f"[{build.name}]",
            pin=pin.name,
            cycle_s=cycle_s,
            hardware=hardware,
            invert=pin.invert,
            shutdown=stopped * self._max_power if hardware else stopped,
        )
        build.add_device(pin.node, self._output, pin)
        build.add_device(pin.node, self)
        self._enable = self._enable_node = None
        enable = build.find_pin(ENABLE_PIN)
        if enable is not None:
            self._enable = DigitalOut(f"the power of [{build.name}]", pin=enable.name, invert=enable.invert)
            self._enable_node = enable.node
            build.add_device(enable.node, self._enable, enable)
        self._add_tachometer(build)
        self._live: ModuleContext | None = None

    def _add_tachometer(self, build: Build) -> None:
        tachometer = build.find_pin(TACHOMETER_PIN)
        pulses, poll_s = build.get(TACHOMETER_PPR), build.get(TACHOMETER_POLL)
        if tachometer is None:
            return
        counter = Counter(
            build.name, pin=tachometer.name, pull=tachometer.pull, poll_s=poll_s, report_s=TACHOMETER_S
        )

        def counted(frequency: float) -> None:
            self.rpm = frequency * 60 / pulses

        counter.on_frequency = counted
        build.add_device(tachometer.node, counter, tachometer)

    def configure(self, config: NodeConfig) -> None:
        """Do nothing: its parts are devices too."""

    def started(self, node: "Node") -> None:
        """Record that the fan is off: its node has started, perhaps during a job."""
        del node
        self.speed = 0.0

    def connect(self, live: "ModuleContext") -> None:
        """Start acting; the fan is off."""
        self._live = live

    def end(self) -> None:
        """Stop acting: the node has set its shutdown speed."""
        self._live = None

    def set_speed(self, speed: float, print_time_s: float = 0.0) -> None:
        """Run at SPEED, 0..1, from a print time on; soon by default. Without effect while not connected."""
        live = self._live
        speed = min(max(speed, 0.0), 1.0)
        if speed < self._off_below:
            speed = 0.0
        if live is None or speed == self.speed:
            return
        before, self.speed = self.speed, speed
        at_s = max(print_time_s, live.print_time_now() + AHEAD_S)
        try:
            self._drive(live, at_s, speed, before)
        except CanductorError as error:
            self.speed = 0.0
            live.say(f"[{self.name}] was not set: {error}")

    def _drive(self, live: "ModuleContext", at_s: float, speed: float, before: float) -> None:
        node = live.node(self.node)
        if self._enable is not None and self._enable_node is not None and (speed > 0) != (before > 0):
            clock = live.ticks_at(self._enable_node, at_s)
            self._enable.set(live.node(self._enable_node), clock, speed > 0)
        starts = speed > 0 and self._kick_s > 0 and (before == 0 or speed - before > MUCH_FASTER)
        if starts and speed < 1:
            self._output.set(node, live.ticks_at(self.node, at_s), self._max_power)
            at_s += self._kick_s
        self._output.set(node, live.ticks_at(self.node, at_s), speed * self._max_power)

    def status(self) -> Mapping[str, Value]:
        """Report how it is."""
        return {"speed": round(self.speed, 4), "rpm": None if self.rpm is None else round(self.rpm, 1)}


class FanModule(Module):
    """A section with a fan."""

    unit: FanUnit

    async def connect(self, live: "ModuleContext") -> None:
        """Start acting."""
        await super().connect(live)
        self.unit.connect(live)

    def end(self, cause: str) -> None:
        """Stop acting."""
        del cause
        self.unit.end()

    def status(self) -> Mapping[str, Value]:
        """Report how the fan is."""
        return self.unit.status()

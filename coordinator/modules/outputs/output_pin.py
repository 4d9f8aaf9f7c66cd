"""[output_pin NAME] and [static_digital_output NAME]: outputs that programs set, or that have one value."""

from collections.abc import Mapping
from typing import ClassVar, Final

from coordinator.config.options import BoolOption, FloatOption, ListOption, SectionSpec
from coordinator.config.pins import PinOption
from coordinator.gcode.commands import Call, Reading, Synchronized
from coordinator.gcode.parameters import one, value
from coordinator.gcode.parser import WordError
from coordinator.modules.base import Build, Module
from coordinator.modules.outputs.timing import AHEAD_S, pwm_cycle
from coordinator.runtime.module_context import ModuleContext
from coordinator.support.values import Value
from nodes.devices.digital_out import DigitalOut
from nodes.devices.pwm_out import PwmOut
from nodes.node.config import NodeConfig
from nodes.node.node import Node
from nodes.support.errors import CanductorError

PIN: Final = PinOption(name="pin", help="the output")
PWM: Final = BoolOption(name="pwm", help="whether it takes values between off and on, by PWM", default=False)
VALUE: Final = FloatOption(name="value", help="value at the start", default=0.0)
SHUTDOWN_VALUE: Final = FloatOption(
    name="shutdown_value",
    help="value when its node stops for safety; without hardware_pwm off or on",
    default=0.0,
)
SCALE: Final = FloatOption(
    name="scale",
    help="value of 'on': values of this section and of SET_PIN are 0 to scale",
    default=1.0,
    above=0,
    maximum=1_000_000,
)
CYCLE_TIME: Final = FloatOption(
    name="cycle_time",
    help="PWM: period",
    default=0.1,
    unit="s",
    minimum=1e-6,
    maximum=5,
)
HARDWARE_PWM: Final = BoolOption(
    name="hardware_pwm", help="PWM: by the node's hardware, where the pin has it", default=False
)
PINS: Final = ListOption(
    name="pins", help="outputs, separated by commas; ! means off, without it they are on"
)


class OutputPins(Module):
    """The outputs that programs set."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.by_name: dict[str, OutputPin] = {}
        build.add_command(
            "SET_PIN",
            "Set an output_pin, synchronized with the moves: PIN= VALUE=",
            self._set,
            while_printing=True,
        )

    def _set(self, call: Call) -> Reading:
        given = call.parameters("PIN", "VALUE")
        pin = self.by_name[one(call.command, given, "PIN", self.by_name)]
        wanted = value(call.command, given, "VALUE")
        if not pin.allows(wanted):
            raise WordError(f"VALUE={wanted:g} of SET_PIN must be {pin.rule} for [{pin.name}]")
        return Synchronized(lambda print_time_s: pin.set(wanted, print_time_s))


class OutputPin(Module):
    """An output that programs set."""

    NAMED: ClassVar = True
    SPEC: ClassVar = SectionSpec(
        help="An output that programs set: SET_PIN PIN=NAME VALUE=",
        options=(PIN, PWM, VALUE, SHUTDOWN_VALUE, SCALE, CYCLE_TIME, HARDWARE_PWM),
        unsupported=("maximum_mcu_duration", "static_value"),
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._pwm, self._scale = build.get(PWM), build.get(SCALE)
        begin, stopped = self._share(build, VALUE), self._share(build, SHUTDOWN_VALUE)
        self._begin = begin
        self._now = begin
        pin = build.pin(PIN)
        self._node = pin.node
        what = f"[{build.name}]"
        self._output: PwmOut | DigitalOut
        if self._pwm:
            hardware = build.get(HARDWARE_PWM)
            if not hardware and stopped not in (0.0, 1.0):
                raise build.reader.bad(SHUTDOWN_VALUE, "which needs hardware_pwm; without it off or on")
            self._begins_late = not hardware and begin not in (0.0, 1.0)
            self._output = PwmOut(
                what,
                pin=pin.name,
                cycle_s=pwm_cycle(build, CYCLE_TIME, hardware=hardware),
                hardware=hardware,
                invert=pin.invert,
                start=stopped if self._begins_late else begin,
                shutdown=stopped,
            )
        else:
            self._begins_late = False
            self._output = DigitalOut(
                what, pin=pin.name, invert=pin.invert, start=begin > 0, shutdown=stopped > 0
            )
        build.add_device(pin.node, self._output, pin)
        build.add_device(pin.node, self)
        build.shared(OutputPins).by_name[build.instance] = self

    def _share(self, build: Build, option: FloatOption) -> float:
        """Return a value of the section as a part of full, 0 to 1."""
        given = build.get(option)
        if not self.allows(given):
            raise build.reader.bad(option, f"which must be {self.rule}")
        return given / self._scale

    def allows(self, wanted: float) -> bool:
        """Return whether it may have a value."""
        return 0 <= wanted <= self._scale if self._pwm else wanted in (0.0, self._scale)

    @property
    def rule(self) -> str:
        """What it may have."""
        return f"0 to {self._scale:g}" if self._pwm else f"0 or {self._scale:g}; with pwm anything between"

    def configure(self, config: NodeConfig) -> None:
        """Do nothing: its output is a device of its own."""

    def started(self, node: "Node") -> None:
        """Record that the output has its start value: its node has started."""
        del node
        self._now = self._begin
        if self._live is not None and self._begins_late:
            self.set(self._begin * self._scale)

    async def connect(self, live: "ModuleContext") -> None:
        """Start acting."""
        await super().connect(live)
        if self._begins_late:
            self.set(self._begin * self._scale)

    def set(self, wanted: float, print_time_s: float = 0.0) -> None:
        """Set a value from a print time on, soon by default. No effect while not connected."""
        live = self._live
        if live is None:
            return
        share = wanted / self._scale
        at_s = max(print_time_s, live.print_time_now() + AHEAD_S)
        try:
            node, clock = live.node(self._node), live.ticks_at(self._node, at_s)
            if isinstance(self._output, PwmOut):
                self._output.set(node, clock, share)
            else:
                self._output.set(node, clock, share > 0)
        except CanductorError as error:
            live.say(f"[{self.name}] was not set: {error}")
            return
        self._now = share

    def end(self, cause: str) -> None:
        """Stop acting: the node has set the output to its shutdown_value."""
        del cause
        self._live = None

    def status(self) -> Mapping[str, Value]:
        """Report its value."""
        return {"value": round(self._now * self._scale, 6)}


class StaticDigitalOutput(Module):
    """Outputs that have one value."""

    NAMED: ClassVar = True
    SPEC: ClassVar = SectionSpec(help="Outputs that are switched once, at the start", options=(PINS,))

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        for pin in build.pins(PINS):
            on = not pin.invert
            output = DigitalOut(f"[{build.name}]", pin=pin.name, start=on, shutdown=on)
            build.add_device(pin.node, output, pin)

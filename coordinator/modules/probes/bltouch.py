"""[bltouch]: a probe whose pin is moved by a servo's signal, as that of ANTCLABS and its copies.

A command is the length of the pulses on the control pin. A new length begins in the gap between two pulses,
so that no pulse is cut: the probe would read it as another command.

By its data sheet the probe has two modes. In that of ``pin_down`` the touch raises a short pulse, and the pin
goes up by itself; in touch mode the sensor shows for as long as it lasts whether the pin is in. What the pin
does is checked: after ``pin_down`` the sensor has to be open, and after ``pin_up`` touch mode has to show
that the pin is in.
"""

import asyncio
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager, suppress
from typing import ClassVar, Final

from coordinator.config.options import BoolOption, ChoiceOption, FloatOption, SectionSpec
from coordinator.config.pins import PinOption
from coordinator.config.sections.probe import SENSOR_PIN
from coordinator.gcode.commands import AtStandstill, Call, Reading
from coordinator.gcode.events import Done
from coordinator.gcode.parser import WordError, quoted
from coordinator.modules.base import Build
from coordinator.modules.probes.probe import MEASURING_OPTIONS, NotReadyError, Probe
from coordinator.modules.probes.probe_commands import ProbeCommands
from coordinator.runtime.module_context import ModuleContext
from nodes.devices.pwm_out import PwmOut
from nodes.node.config import NodeConfig
from nodes.node.node import Node
from nodes.support.errors import CanductorError

CYCLE_S: Final = 0.020
PULSES_S: Final = {
    "pin_down": 0.000647,
    "touch_mode": 0.001162,
    "pin_up": 0.001475,
    "self_test": 0.001782,
    "output_mode_store": 0.001884,
    "set_5v_output_mode": 0.001988,
    "set_od_output_mode": 0.002091,
    "reset": 0.002194,
}
"""Length of the pulses of each command, by the data sheet."""
HOLD_S: Final = 0.1
"""How long a command is sent at least."""
LEAD_S: Final = 0.25
"""How far ahead commands are sent to the node: late ones would stop it, and hosts are sometimes slow."""
RESET_S: Final = 0.5
"""What a reset takes."""
ATTEMPTS: Final = 3
OUTPUT_MODES: Final = ("5V", "OD")

CONTROL_PIN: Final = PinOption(name="control_pin", help="output of the servo's signal")
MOVE_TIME: Final = FloatOption(
    name="pin_move_time",
    help="how long the pin may take to move",
    default=0.680,
    unit="s",
    above=0,
    maximum=10,
)
STOW_EACH: Final = BoolOption(
    name="stow_on_each_sample",
    help="whether the pin is raised and checked after each measurement, not once per command",
    default=True,
)
TOUCH_MODE: Final = BoolOption(
    name="probe_with_touch_mode",
    help="whether to measure in touch mode, in which the pin stays down at the touch",
    default=False,
)
UP_IS_OPEN: Final = BoolOption(
    name="pin_up_reports_not_triggered",
    help="whether the sensor is open after pin_up; False for copies of which that is not true",
    default=True,
)
UP_IS_TRIGGERED: Final = BoolOption(
    name="pin_up_touch_mode_reports_triggered",
    help="whether touch mode shows the raised pin as triggered; False for copies of which that is not true",
    default=True,
)
OUTPUT_MODE: Final = ChoiceOption(
    name="set_output_mode",
    help="what the sensor's output is set to at the start (from V3.0 on); by default it is not set",
    choices=OUTPUT_MODES,
)


class BLTouch(Probe):
    """The probe of [bltouch]."""

    INPUT = SENSOR_PIN
    HAS_LINES: ClassVar = False
    SPEC = SectionSpec(
        "A probe with a pin that is moved by a servo's signal: BLTouch, CR Touch, 3D Touch",
        (
            SENSOR_PIN,
            CONTROL_PIN,
            MOVE_TIME,
            STOW_EACH,
            TOUCH_MODE,
            UP_IS_OPEN,
            UP_IS_TRIGGERED,
            OUTPUT_MODE,
            *MEASURING_OPTIONS,
        ),
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        build.shared(ProbeCommands)
        self._move_s = build.get(MOVE_TIME)
        self._stow_each = build.get(STOW_EACH)
        self._touch_mode = build.get(TOUCH_MODE)
        self._up_is_open, self._up_is_triggered = build.get(UP_IS_OPEN), build.get(UP_IS_TRIGGERED)
        self._output_mode = build.find(OUTPUT_MODE)
        pin = build.pin(CONTROL_PIN)
        self._node = pin.node
        self._output = PwmOut(
            "the control pin of [bltouch]", pin=pin.name, cycle_s=CYCLE_S, invert=pin.invert
        )
        build.add_device(pin.node, self._output, pin)
        build.add_device(pin.node, self)
        self._begun_clock: int | None = None
        """Of the node: when a cycle of its signal began; None: it has none."""
        self._keeps_down = False
        """Whether the pin stays down between the measurements of a command."""
        self._is_down = False
        for name, text, read in (
            ("BLTOUCH_DEBUG", "Send the BLTouch a command: COMMAND=", self._read_debug),
            ("BLTOUCH_STORE", "Store the BLTouch's output mode in it: MODE=5V or OD", self._read_store),
        ):
            build.add_command(name, text, read)

    # ------------------------------------------------------------------------------------------- its signal

    def configure(self, config: NodeConfig) -> None:
        """Do nothing: its output is a device of its own."""

    def started(self, node: Node) -> None:
        """Record that there is no signal: its node has started."""
        del node
        self._begun_clock, self._is_down = None, False

    async def connect(self, live: ModuleContext) -> None:
        """Set its output mode and raise its pin, which is checked when it is needed."""
        await super().connect(live)
        if self._output_mode is not None:
            await self._send(f"set_{self._output_mode.lower()}_output_mode")
        await self._send("pin_up")

    async def _send(self, command: str, hold_s: float = HOLD_S) -> None:
        """Send COMMAND, for HOLD_S at least; raises CanductorError."""
        live = self.live
        node = live.node(self._node)
        soon_s = live.print_time_now() + LEAD_S
        soon = clock = live.ticks_at(self._node, soon_s)
        if self._begun_clock is not None:
            cycle = round(CYCLE_S * node.clock_freq_hz)
            gap = self._begun_clock + cycle // 2
            clock = gap + -(-(soon - gap) // cycle) * cycle
        self._output.set(node, clock, PULSES_S[command] / CYCLE_S)
        self._begun_clock = clock
        at_s = soon_s + (clock - soon) / node.clock_freq_hz
        await asyncio.sleep(at_s + max(hold_s, HOLD_S) - live.print_time_now())

    # ---------------------------------------------------------------------------------------------- its pin

    @property
    def stays_deployed(self) -> bool:
        """Whether the pin stays down between the measurements of a command."""
        return not self._stow_each

    async def begin(self) -> None:
        """Note that what follows are measurements of one command."""
        self._keeps_down = True

    async def finish(self) -> None:
        """Raise the pin, if it is down."""
        self._keeps_down = False
        if self._is_down:
            await self._raise_pin()

    def touching(self, *, alone: bool) -> AbstractAsyncContextManager[None]:
        """Return what lowers the pin for one way down, and raises it after."""
        if alone:
            self._keeps_down = False
        return self._touching()

    @asynccontextmanager
    async def _touching(self) -> AsyncIterator[None]:
        await self._lower_pin()
        try:
            yield
        except BaseException:
            self._keeps_down = self._is_down = False
            if self.live.machine.stopped is None:
                with suppress(CanductorError):  # what was wrong before is what counts; the next use looks
                    await self._send("pin_up")
            raise
        if not self._keeps_down:
            await self._raise_pin()

    async def _lower_pin(self) -> None:
        if self._is_down and not self._touch_mode:
            await self._send("pin_up")  # at the touch it went up by itself: pin_down has to be a new command
        self._is_down = True
        for _ in range(ATTEMPTS):
            await self._send("pin_down", self._move_s)
            if self._touch_mode:
                await self._send("touch_mode")
            if not await self.is_triggered():
                return
            await self._reset()
        self._is_down = False
        raise NotReadyError(
            f"the BLTouch did not lower its pin: {ATTEMPTS} times its sensor was triggered after pin_down;"
            " lift the head, and check that the pin moves freely, and the wiring"
        )

    async def _raise_pin(self) -> None:
        self._is_down = False
        why = ""
        for _ in range(ATTEMPTS):
            await self._send("pin_up", self._move_s)
            why = await self._why_not_up()
            if not why:
                return
            await self._reset()
        raise NotReadyError(
            f"the BLTouch did not raise its pin: {ATTEMPTS} times {why}; check that the pin moves freely, and"
            " the wiring"
        )

    async def _why_not_up(self) -> str:
        if self._up_is_open and await self.is_triggered():
            return (
                "its sensor was triggered after pin_up (a copy of which that is usual needs"
                " pin_up_reports_not_triggered: False)"
            )
        if not self._up_is_triggered:
            return ""
        await self._send("touch_mode")
        shown = await self.is_triggered()
        await self._send("pin_up")
        if shown:
            return ""
        return (
            "touch mode did not show the pin as raised (a copy of which that is usual needs"
            " pin_up_touch_mode_reports_triggered: False)"
        )

    async def _reset(self) -> None:
        await self._send("reset", RESET_S)
        await self._send("pin_up", self._move_s)

    # --------------------------------------------------------------------------------------------- commands

    def _read_debug(self, call: Call) -> Reading:
        asked = call.parameters("COMMAND").get("COMMAND", "")
        command = asked.lower()
        if command not in PULSES_S:
            raise WordError(
                f"COMMAND of BLTOUCH_DEBUG is {quoted(asked)}; one of {', '.join(PULSES_S)} is possible"
            )

        async def debug() -> Done:
            await self._send(command)
            return Done((f"the BLTouch was sent {command}",))

        return AtStandstill(debug)

    def _read_store(self, call: Call) -> Reading:
        asked = call.parameters("MODE").get("MODE", "")
        mode = asked.upper()
        if mode not in OUTPUT_MODES:
            raise WordError(
                f"MODE of BLTOUCH_STORE is {quoted(asked)}; {' or '.join(OUTPUT_MODES)} is possible"
            )

        set_mode = f"set_{mode.lower()}_output_mode"

        async def store() -> Done:
            for command in (set_mode, "output_mode_store", set_mode, "pin_up"):
                await self._send(command)
            return Done((f"the BLTouch was sent to store output mode {mode}",))

        return AtStandstill(store)

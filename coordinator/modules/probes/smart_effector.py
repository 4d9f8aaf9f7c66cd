"""[smart_effector]: the nozzle as probe, on strain gauges whose sensitivity is programmed.

The effector reads its program from the control pin, at 1000 bits per second: each byte comes as 0 0 1 0, four
bits, the inverse of the last one, four bits, the inverse of the last one; the highest bit first. It stores
105, the sensitivity and the inverse of that; 131 twice brings its own back.
"""

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from itertools import pairwise
from typing import Final

from coordinator.config.options import FloatOption, SectionSpec
from coordinator.config.pins import PinOption
from coordinator.config.sections.probe import PIN
from coordinator.gcode.commands import AtStandstill, Call, Reading
from coordinator.gcode.events import Done
from coordinator.gcode.parameters import bounded
from coordinator.gcode.parser import WordError
from coordinator.modules.base import Build
from coordinator.modules.probes.probe import LINE_OPTIONS, MEASURING_OPTIONS, Probe
from coordinator.modules.probes.probe_commands import ProbeCommands
from nodes.devices.digital_out import DigitalOut

BIT_S: Final = 0.001
SENSITIVITY: Final = 105
FACTORY: Final = 131
SETTLE_S: Final = 0.1
"""After a program, before anything else is done."""
MAX_ACCEL: Final = 1_000_000.0
MAX_RECOVERY_S: Final = 60.0

CONTROL_PIN: Final = PinOption(
    name="control_pin", help="output to the effector's control input; SET_SMART_EFFECTOR SENSITIVITY needs it"
)
ACCEL: Final = FloatOption(
    name="probe_accel",
    help="acceleration of the way down at most; by default that of Z",
    unit="mm/s²",
    above=0,
    maximum=MAX_ACCEL,
)
RECOVERY: Final = FloatOption(
    name="recovery_time",
    help="how long the head stands still before the way down: moves shake the sensor",
    default=0.4,
    unit="s",
    minimum=0,
    maximum=MAX_RECOVERY_S,
)


class SmartEffector(Probe):
    """The probe of [smart_effector]."""

    SPEC = SectionSpec(
        "The nozzle as probe, by strain gauges: the Smart Effector of Duet3D",
        (PIN, CONTROL_PIN, ACCEL, RECOVERY, *MEASURING_OPTIONS, *LINE_OPTIONS),
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        build.shared(ProbeCommands)
        self._accel, self._recovery_s = build.find(ACCEL), build.get(RECOVERY)
        self._output: DigitalOut | None = None
        pin = build.find_pin(CONTROL_PIN)
        if pin is not None:
            self._node = pin.node
            self._output = DigitalOut("the control pin of [smart_effector]", pin=pin.name, invert=pin.invert)
            build.add_device(pin.node, self._output, pin)
        for name, text, read in (
            (
                "SET_SMART_EFFECTOR",
                "Program the effector's SENSITIVITY (0 to 255); set ACCEL and RECOVERY_TIME until a restart",
                self._read_set,
            ),
            ("RESET_SMART_EFFECTOR", "Program the effector's own sensitivity", self._read_reset),
        ):
            build.add_command(name, text, read)

    @property
    def probing_accel(self) -> float | None:
        """Acceleration of the way down at most, mm/s²."""
        return self._accel

    def touching(self, *, alone: bool) -> AbstractAsyncContextManager[None]:
        """Return what waits until the head no longer shakes."""
        del alone
        return self._touching()

    @asynccontextmanager
    async def _touching(self) -> AsyncIterator[None]:
        await asyncio.sleep(self._recovery_s)
        yield

    # --------------------------------------------------------------------------------------------- commands

    def _read_set(self, call: Call) -> Reading:
        command = call.command
        given = call.parameters("SENSITIVITY", "ACCEL", "RECOVERY_TIME")
        sensitivity = round(bounded(command, given, "SENSITIVITY", -1, low=0, high=255))
        accel = bounded(command, given, "ACCEL", -1, low=1, high=MAX_ACCEL)
        recovery_s = bounded(command, given, "RECOVERY_TIME", -1, low=0, high=MAX_RECOVERY_S)
        if "SENSITIVITY" in given:
            self._check_control(call)

        async def act() -> Done:
            replies = []
            if "SENSITIVITY" in given:
                await self._program(SENSITIVITY, sensitivity, 255 - sensitivity)
                replies.append(f"the effector was sent sensitivity {sensitivity}")
            if "ACCEL" in given:
                self._accel = accel
                replies.append(f"probe_accel: {accel:g} mm/s²")
            if "RECOVERY_TIME" in given:
                self._recovery_s = recovery_s
                replies.append(f"recovery_time: {recovery_s:g} s")
            return Done(tuple(replies))

        return AtStandstill(act)

    def _read_reset(self, call: Call) -> Reading:
        call.parameters()
        self._check_control(call)

        async def act() -> Done:
            await self._program(FACTORY, FACTORY)
            return Done(("the effector was sent to use its own sensitivity",))

        return AtStandstill(act)

    def _check_control(self, call: Call) -> None:
        if self._output is None:
            raise WordError(f"{call.command.name} needs control_pin of [smart_effector], which is not given")

    async def _program(self, *program: int) -> None:
        """Send PROGRAM (bytes); raises CanductorError."""
        live, output = self.live, self._output
        assert output is not None
        node = live.node(self._node)
        begin_s = live.soon()
        clock, bit_ticks = live.ticks_at(self._node, begin_s), BIT_S * node.clock_freq_hz
        bits = [*bits_of(program), 0]
        changes = [
            (clock + round(number * bit_ticks), bool(bit))
            for number, (before, bit) in enumerate(pairwise((0, *bits)))
            if bit != before
        ]
        output.send_burst(node, changes)
        await asyncio.sleep(begin_s + len(bits) * BIT_S + SETTLE_S - live.print_time_now())


def bits_of(program: tuple[int, ...]) -> Iterator[int]:
    """Yield the bits by which PROGRAM (bytes) is sent.

    >>> "".join(map(str, bits_of((105,))))
    '00100110110010'
    """
    for byte in program:
        bits = [byte >> shift & 1 for shift in range(7, -1, -1)]
        yield from (0, 0, 1, 0, *bits[:4], 1 - bits[3], *bits[4:], 1 - bits[7])

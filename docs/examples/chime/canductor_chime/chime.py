"""[chime]: a bell or buzzer on a pin of any node, rung by the command CHIME at its place among the moves."""

from typing import Final

from coordinator.config.options import FloatOption, SectionSpec
from coordinator.config.pins import PinOption
from coordinator.gcode.commands import Call, Reading, Synchronized
from coordinator.gcode.parser import WordError, quoted
from coordinator.modules.base import Build, Module
from coordinator.support.values import Value
from nodes.devices.digital_out import DigitalOut

LENGTH_MAX_S: Final = 5.0
PIN: Final = PinOption(name="pin", help="the bell's output; ! when low means ringing")
LENGTH: Final = FloatOption(
    name="length",
    help="how long one CHIME rings",
    default=0.2,
    unit="s",
    minimum=0.01,
    maximum=LENGTH_MAX_S,
)


class Chime(Module):
    """Rings."""

    SPEC = SectionSpec("A bell that programs ring with CHIME", (PIN, LENGTH))

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        pin = build.pin(PIN)
        self._length_s = build.get(LENGTH)
        self._node = pin.node
        # If the host dies while it rings, its node ends that by itself.
        self._bell = DigitalOut(
            f"[{build.name}]", pin=pin.name, invert=pin.invert, max_duration_s=LENGTH_MAX_S + 1
        )
        self._rung = 0
        build.add_device(self._node, self._bell)
        build.add_command("CHIME", "Ring the bell for LENGTH seconds", self._read)

    def status(self) -> dict[str, Value]:
        """Report how often it rang."""
        return {"rung": self._rung}

    def _read(self, call: Call) -> Reading:
        """Check the parameters; this also happens where a program is only planned."""
        text = call.parameters("LENGTH").get("LENGTH")
        length_s = self._length_s
        if text is not None:
            try:
                length_s = float(text)
            except ValueError:
                length_s = 0.0
            if not 0.01 <= length_s <= LENGTH_MAX_S:
                raise WordError(
                    f"LENGTH of CHIME is {quoted(text)}; it must be a number of s from 0.01 to"
                    f" {LENGTH_MAX_S:g}"
                )
        return Synchronized(lambda print_time_s: self._ring(print_time_s, length_s))

    def _ring(self, print_time_s: float, length_s: float) -> None:
        """Ring from PRINT_TIME_S on; both edges are queued on the node, which makes them in time."""
        live = self.live
        begin_s = live.soon(print_time_s)
        for at_s, on in ((begin_s, True), (begin_s + length_s, False)):
            self._bell.set(live.node(self._node), live.ticks_at(self._node, at_s), on)
        self._rung += 1

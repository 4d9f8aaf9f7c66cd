"""A counter on a node: changes of an input, for the speed of a fan."""

from collections.abc import Callable
from typing import Final

from nodes.clock.clock import ticks_since
from nodes.devices.device import Device, ignore
from nodes.devices.ticks import start_clock, ticks_for
from nodes.dictionary.message_format import Message
from nodes.node.config import NodeConfig
from nodes.node.node import Node

COMMANDS: Final = ("config_counter", "query_counter")
RESPONSES: Final = ("counter_state oid=%c count=%u count_clock=%u",)
_MODULUS: Final = 1 << 32


class Counter(Device):
    """The counter for NAME on PIN, PULL 1 for a pull-up; sampled every POLL_S, reported every REPORT_S.

    ``on_frequency`` is called with the pulses (two changes each) per s since the previous report; 0 when
    nothing changed.
    """

    def __init__(
        self, name: str, *, pin: str, pull: int = 0, poll_s: float = 0.0015, report_s: float = 1.0
    ) -> None:
        super().__init__(f"the tachometer of {name}")
        self.on_frequency: Callable[[float], None] = ignore
        self._pin = pin
        self._pull = pull
        self._poll_s, self._report_s = poll_s, report_s
        self._poll_ticks = self._report_ticks = 1
        self._freq_hz = 1
        self._last: tuple[int, int] | None = None

    def configure(self, config: NodeConfig) -> None:
        """Add it to its node's CONFIG; NodeConfigError when firmware or pin do not allow it."""
        what = self.description
        config.require(what, COMMANDS, RESPONSES)
        self._poll_ticks = ticks_for(config, what, self._poll_s)
        self._report_ticks = ticks_for(config, what, self._report_s)
        self._freq_hz = config.dictionary.clock_freq_hz
        self.oid = config.create_oid()
        config.add_config(what, f"config_counter oid={self.oid} pin={self._pin} pull_up={self._pull}")

    def started(self, node: Node) -> None:
        """Begin to count, as NODE has become ready."""
        self._last = None
        self._on_report(node, "counter_state", self._received)
        node.send(
            "query_counter",
            oid=self._oid,
            clock=start_clock(node) % _MODULUS,
            poll_ticks=self._poll_ticks,
            sample_ticks=self._report_ticks,
        )

    def _received(self, message: Message) -> None:
        """Process a report: from the last change of the previous report to the last one of this."""
        now = message.integer("count"), message.integer("count_clock")
        last, self._last = self._last, now
        if last is None:
            return
        changes, ticks = (now[0] - last[0]) % _MODULUS, ticks_since(now[1], last[1])
        self.on_frequency(changes / 2 * self._freq_hz / ticks if ticks > 0 else 0.0)

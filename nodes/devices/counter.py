"""A counter on a node: changes of an input, for the speed of a fan."""

from collections.abc import Callable
from typing import Final

from nodes.clock.clock import ticks_since
from nodes.devices.ticks import start_clock, ticks_for
from nodes.dictionary.message_format import Message
from nodes.node.config import NodeConfig
from nodes.node.errors import NodeError
from nodes.node.node import Node

COMMANDS: Final = ("config_counter", "query_counter")
_WHOLE: Final = 1 << 32


def _ignore(_: float) -> None:
    pass


class Counter:
    """The counter for NAME on PIN, PULL 1 for a pull-up; looks every POLL_S and reports every REPORT_S.

    ``on_frequency`` is called with the pulses (two changes each) per s since the report before; a report in
    which nothing changed says 0.
    """

    def __init__(
        self, name: str, *, pin: str, pull: int = 0, poll_s: float = 0.0015, report_s: float = 1.0
    ) -> None:
        self.name = name
        self.oid: int | None = None
        """Its object id; known when its node's configuration is built."""
        self.on_frequency: Callable[[float], None] = _ignore
        self._pin = pin
        self._pull = pull
        self._poll_s, self._report_s = poll_s, report_s
        self._poll_ticks = self._report_ticks = 1
        self._freq_hz = 1
        self._last: tuple[int, int] | None = None
        self._unlisten: Callable[[], None] | None = None

    def configure(self, config: NodeConfig) -> None:
        """Add it to its node's CONFIG; NodeConfigError when firmware or pin do not allow it."""
        what = f"the tachometer of {self.name}"
        config.require(what, COMMANDS)
        self._poll_ticks = ticks_for(config, what, self._poll_s)
        self._report_ticks = ticks_for(config, what, self._report_s)
        self._freq_hz = config.dictionary.clock_freq_hz
        self.oid = config.create_oid()
        config.add_config(what, f"config_counter oid={self.oid} pin={self._pin} pull_up={self._pull}")

    def started(self, node: "Node") -> None:
        """Begin to count, as NODE has become ready."""
        if self.oid is None:
            raise NodeError(f"the tachometer of {self.name} is not configured on any node")
        if self._unlisten is not None:
            self._unlisten()
        self._last = None
        self._unlisten = node.on("counter_state", self.oid, self._came)
        node.send(
            "query_counter",
            oid=self.oid,
            clock=start_clock(node) % _WHOLE,
            poll_ticks=self._poll_ticks,
            sample_ticks=self._report_ticks,
        )

    def _came(self, message: Message) -> None:
        """Take a report: from the last change of the report before to the last one of this."""
        now = message.integer("count"), message.integer("count_clock")
        last, self._last = self._last, now
        if last is None:
            return
        changes, ticks = (now[0] - last[0]) % _WHOLE, ticks_since(now[1], last[1])
        self.on_frequency(changes / 2 * self._freq_hz / ticks if ticks > 0 else 0.0)

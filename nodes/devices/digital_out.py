"""A digital output on a node."""

from collections.abc import Iterable
from typing import Final

from nodes.devices.timed_output import TimedOutput
from nodes.node.config import NodeConfig
from nodes.node.node import Node

COMMANDS: Final = ("config_digital_out", "queue_digital_out", "update_digital_out")


class DigitalOut(TimedOutput):
    """The output for NAME on PIN; INVERT: on is low. It begins with START and has SHUTDOWN after a shutdown.

    MAX_DURATION_S: see timed_output.py.
    """

    command = "queue_digital_out"
    value_parameter = "on_ticks"

    def __init__(
        self,
        name: str,
        *,
        pin: str,
        invert: bool = False,
        start: bool = False,
        shutdown: bool = False,
        max_duration_s: float = 0.0,
    ) -> None:
        super().__init__(name, max_duration_s=max_duration_s)
        self._pin = pin
        self._invert = invert
        self._start, self._shutdown = start, shutdown

    def configure(self, config: NodeConfig) -> None:
        """Add it to its node's CONFIG; NodeConfigError when firmware or pin do not allow it."""
        self._add_to(config, COMMANDS)
        config.add_config(
            self.name,
            f"config_digital_out oid={self.oid} pin={self._pin} value={self._level(self._start)}"
            f" default_value={self._level(self._shutdown)} max_duration={self._duration_ticks(config)}",
        )

    def set(self, node: Node, clock: int, on: bool) -> None:
        """Switch it at CLOCK (64 bits, later than now by the transit time to the node)."""
        self._queue(node, clock, self._level(on))

    def send_burst(self, node: Node, changes: Iterable[tuple[int, bool]]) -> None:
        """Switch it at clocks that follow closely; only where NODE makes no steps until then.

        The changes are sent at once and take the slots of steps, too. Raises NodeError.
        """
        for clock, on in changes:
            self._send(node, self._oid, clock, self._level(on))

    def set_now(self, node: Node, on: bool) -> None:
        """Switch it when the command arrives; not while a value of ``set`` is pending."""
        node.send("update_digital_out", oid=self._oid, value=self._level(on))

    def _start_value(self) -> int:
        return self._level(self._start)

    def _begin_again(self, node: Node) -> None:
        self.set_now(node, self._start)  # so that ``set_now`` is possible from now on

    def _level(self, on: bool) -> int:
        return int(on != self._invert)

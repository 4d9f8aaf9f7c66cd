"""What outputs with a time for each value have in common: order, and the node's own safety net.

MAX_DURATION_S: a value other than the default lasts so long at most on the node; whoever wants it for longer
renews it before that. Else the node shuts down, by itself, and every output of it takes its default. 0: no
such limit.
"""

from typing import TYPE_CHECKING

from nodes.devices.ticks import ticks_for
from nodes.node_config import NodeConfig
from nodes.node_errors import NodeError

if TYPE_CHECKING:
    from nodes.node import Node  # planning needs no node, which draws in asyncio


class TimedOutput:
    """An output for NAME; the subclasses say what a value is."""

    command = ""
    """That queues a value, with clock and VALUE_PARAMETER."""
    value_parameter = ""

    def __init__(self, name: str, *, max_duration_s: float) -> None:
        self.name = name
        self.max_duration_s = max_duration_s
        self.oid: int | None = None
        """Its object id; known when its node's configuration is built."""
        self._last_clock = 0

    def started(self, node: "Node") -> None:
        """Take note that NODE has become ready, with the output as it was configured."""
        del node
        self._last_clock = 0

    def _duration_ticks(self, config: NodeConfig) -> int:
        return ticks_for(config, self.name, self.max_duration_s) if self.max_duration_s else 0

    def _queue(self, node: "Node", clock: int, value: int) -> None:
        """Have VALUE from CLOCK (64 bits) on, yet not before the value queued last."""
        if self.oid is None:
            raise NodeError(f"the output of {self.name} is not configured on any node")
        self._last_clock = clock = max(clock, self._last_clock)
        values = {self.value_parameter: value}
        node.send(self.command, req_clock=clock, oid=self.oid, clock=clock % 2**32, **values)

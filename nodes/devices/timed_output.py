"""What outputs with a time for each value have in common: order, slots, and the node's own safety net.

MAX_DURATION_S: a value other than the default lasts so long at most on the node; whoever wants it for longer
renews it before that. Else the node shuts down, by itself, and every output of it takes its default. 0: no
such limit.

A value takes a slot of the node's move queue until its clock. An output has only so many (queue_slots.py):
further values wait here until one is free. Of values too close together for that, those whose time passes
while they wait are left out but for the last of them, which comes a little late.
"""

import asyncio
from collections import deque
from typing import Final

from nodes.devices.ticks import clock_after, ticks_for
from nodes.node.config import NodeConfig
from nodes.node.errors import NodeError
from nodes.node.node import Node
from nodes.node.states import NodeState

FREE_AFTER_S: Final = 0.002
"""So long behind a value's clock, as the host knows that clock, its slot is free for certain."""
WAY_S: Final = 0.1
"""A value that waited for a slot is given so long to reach its node, on a bus with much traffic."""


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
        self._held: deque[int] = deque()
        """Clocks of the values that may still hold a slot of the node."""
        self._waiting: deque[tuple[int, int]] = deque()
        """Clocks and values for which there is no slot yet."""
        self._timer: asyncio.TimerHandle | None = None

    def started(self, node: "Node") -> None:
        """Take note that NODE has become ready, with the output as it was configured."""
        del node
        self._last_clock = 0
        self._forget()

    def _duration_ticks(self, config: NodeConfig) -> int:
        return ticks_for(config, self.name, self.max_duration_s) if self.max_duration_s else 0

    def _queue(self, node: "Node", clock: int, value: int) -> None:
        """Have VALUE from CLOCK (64 bits) on, yet not before the value queued last.

        Raises NodeError when the node cannot take it.
        """
        if self.oid is None:
            raise NodeError(f"the output of {self.name} is not configured on any node")
        self._last_clock = clock = max(clock, self._last_clock)
        if not self._waiting and self._has_slot(node):
            self._send(node, clock, value)
            return
        self._waiting.append((clock, value))
        self._wait(node)

    # ---------------------------------------------------------------------------------------------- slots

    def _send(self, node: "Node", clock: int, value: int) -> None:
        assert self.oid is not None
        values = {self.value_parameter: value}
        node.send(self.command, req_clock=clock, oid=self.oid, clock=clock % 2**32, **values)
        self._held.append(clock)

    def _has_slot(self, node: "Node") -> bool:
        if len(self._held) >= node.output_slots:
            now = clock_after(node, -FREE_AFTER_S)
            while self._held and self._held[0] <= now:
                self._held.popleft()
        return len(self._held) < node.output_slots

    def _wait(self, node: "Node") -> None:
        """Come back when the first slot is free."""
        if self._timer is None:
            due_s = (self._held[0] - clock_after(node, -FREE_AFTER_S)) / node.clock_freq_hz
            self._timer = asyncio.get_running_loop().call_later(max(due_s, 0.0), self._go_on, node)

    def _go_on(self, node: "Node") -> None:
        """Send what there are slots for."""
        self._timer = None
        if node.state is not NodeState.READY:
            self._forget()
            return
        while self._waiting and self._has_slot(node):
            soonest = clock_after(node, WAY_S)
            clock, value = self._waiting.popleft()
            while self._waiting and self._waiting[0][0] <= soonest:
                clock, value = self._waiting.popleft()
            clock = max(clock, soonest)
            self._last_clock = max(clock, self._last_clock)
            self._send(node, clock, value)
        if self._waiting:
            self._wait(node)

    def _forget(self) -> None:
        self._held.clear()
        self._waiting.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

"""Base of outputs whose values have a time: order, queue slots, and the node's own time limit.

MAX_DURATION_S: the longest that a value other than the default may last on the node; to keep it longer, renew
it in time. Otherwise the node shuts down by itself, and each of its outputs takes its default. 0: no limit.

A value takes a slot of the node's move queue until its clock. An output has a limited number of slots
(queue_slots.py); further values wait here until one is free. Of the values whose time passes while they wait,
only the last is sent, a little late.
"""

import asyncio
from abc import abstractmethod
from collections import deque
from typing import Final

from nodes.devices.device import Device
from nodes.devices.ticks import clock_after, ticks_for
from nodes.node.config import NodeConfig
from nodes.node.node import Node
from nodes.node.states import NodeState

FREE_AFTER_S: Final = 0.002
"""Time after a value's clock, as the host estimates it, at which its slot is certainly free."""
TRANSIT_S: Final = 0.1
"""Time that a value that waited for a slot has to reach its node, on a bus with much traffic."""


class TimedOutput(Device):
    """An output for NAME; the subclasses define what a value is."""

    command = ""
    """Command that queues a value, with clock and VALUE_PARAMETER."""
    value_parameter = ""

    def __init__(self, name: str, *, max_duration_s: float) -> None:
        super().__init__(f"the output of {name}")
        self.name = name
        self.max_duration_s = max_duration_s
        self._last_clock = 0
        self._held: deque[int] = deque()
        """Clocks of the values that may still occupy a slot of the node."""
        self._waiting: deque[tuple[int, int]] = deque()
        """Clocks and values that have no slot yet."""
        self._timer: asyncio.TimerHandle | None = None

    @abstractmethod
    def _start_value(self) -> int:
        """Return the value with which the output begins."""

    def started(self, node: Node) -> None:
        """Begin with the start value: NODE has become ready.

        One that kept its configuration still drives what it was last told, perhaps by another host.
        """
        self._last_clock = 0
        self._clear()
        if node.kept_configuration:
            self._begin_again(node)

    def _begin_again(self, node: Node) -> None:
        self._queue(node, clock_after(node, TRANSIT_S), self._start_value())

    def _add_to(self, config: NodeConfig, commands: tuple[str, ...]) -> None:
        """Add it to its node's CONFIG, which has to have COMMANDS."""
        config.require(self.description, commands)
        self.oid = config.create_oid()
        config.timed_outputs += 1

    def _duration_ticks(self, config: NodeConfig) -> int:
        return ticks_for(config, self.name, self.max_duration_s) if self.max_duration_s else 0

    def _queue(self, node: Node, clock: int, value: int) -> None:
        """Set VALUE at CLOCK (64 bits), but not before the value queued last.

        Raises NodeError when the node cannot accept it.
        """
        oid = self._oid
        node.check_ready()  # before anything waits for a slot: it may have none
        self._last_clock = clock = max(clock, self._last_clock)
        if not self._waiting and self._has_slot(node):
            self._send(node, oid, clock, value)
            return
        self._waiting.append((clock, value))
        self._wait(node)

    # ---------------------------------------------------------------------------------------------- slots

    def _send(self, node: Node, oid: int, clock: int, value: int) -> None:
        values = {self.value_parameter: value}
        node.send(self.command, req_clock=clock, oid=oid, clock=clock % 2**32, **values)
        self._held.append(clock)

    def _has_slot(self, node: Node) -> bool:
        if len(self._held) >= node.output_slots:
            now = clock_after(node, -FREE_AFTER_S)
            while self._held and self._held[0] <= now:
                self._held.popleft()
        return len(self._held) < node.output_slots

    def _wait(self, node: Node) -> None:
        """Continue when the first slot is free."""
        if self._timer is None:
            due_s = (self._held[0] - clock_after(node, -FREE_AFTER_S)) / node.clock_freq_hz
            self._timer = asyncio.get_running_loop().call_later(max(due_s, 0.0), self._continue, node)

    def _continue(self, node: Node) -> None:
        """Send the values for which there are slots."""
        self._timer = None
        if node.state is not NodeState.READY:
            self._clear()
            return
        while self._waiting and self._has_slot(node):
            soonest = clock_after(node, TRANSIT_S)
            clock, value = self._waiting.popleft()
            while self._waiting and self._waiting[0][0] <= soonest:
                clock, value = self._waiting.popleft()
            clock = max(clock, soonest)
            self._last_clock = max(clock, self._last_clock)
            self._send(node, self._oid, clock, value)
        if self._waiting:
            self._wait(node)

    def _clear(self) -> None:
        self._held.clear()
        self._waiting.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

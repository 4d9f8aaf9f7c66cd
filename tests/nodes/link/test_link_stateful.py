"""Hypothesis drives a link, its twin node and the line between them: whatever happens, once and in order."""

import struct
from collections.abc import Iterable

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from tests.nodes.link.damages import DAMAGES
from tests.nodes.link.twin import STOP, NodeTwin, WindowObserver, ask, store
from tests.nodes.link.virtual import MS, CoreLink, Delivery, Line
from tests.profiles import examples
from tests.wire_twin import read_vlq

HZ = 1_000_000
NAMES = sorted(DAMAGES)


class LinkMachine(RuleBasedStateMachine):
    """Control and motion are each a list of commands that has to arrive as it is."""

    @initialize(expected=st.integers(0, 15), window=st.integers(64, 400))
    def start(self, expected: int, window: int) -> None:
        self.damages: list[tuple[int, str]] = []
        # The link may be cut for long: what is tested here is not when it is given up.
        link = CoreLink(window, 600_000 * MS)
        node = NodeTwin(expected, max(window, 192) + 64)
        self.line = Line(link, node, self.fault, observer=WindowObserver(window))
        link.set_clock(HZ, self.line.now, 2**32 - HZ)
        self.number = 0
        self.control: list[bytes] = []
        self.motion: list[bytes] = []

    def fault(self, way: int, index: int, data: bytes) -> Iterable[Delivery]:
        for at, (direction, name) in enumerate(self.damages):
            if direction == way:
                del self.damages[at]
                return DAMAGES[name](data)
        return [(0, data)]

    def ticks(self) -> int:
        return int(self.line.now // 1000) - 1_000_000 + 2**32 - HZ

    @rule(size=st.integers(0, 50), wait_ms=st.integers(-5, 30))
    def send(self, size: int, wait_ms: int) -> None:
        self.number += 1
        command = store(self.number * 2, size)
        gate = self.ticks() + wait_ms * 1000 if wait_ms > 0 else 0
        if self.line.link.send(command, gate, gate) == 0:
            self.control.append(command)

    @rule()
    def ask(self) -> None:
        self.number += 1
        command = ask(self.number * 2)
        if self.line.link.send(command) == 0:
            self.control.append(command)

    @rule(
        sizes=st.lists(st.integers(0, 50), max_size=8), wait_ms=st.integers(-5, 30), ahead=st.integers(0, HZ)
    )
    def send_batch(self, sizes: list[int], wait_ms: int, ahead: int) -> None:
        commands = []
        for size in sizes:
            self.number += 1
            commands.append(store(self.number * 2 + 1, size))
        gate = self.ticks() + wait_ms * 1000 if wait_ms > 0 else 0
        due = self.ticks() + ahead
        batch = b"".join(struct.pack("=QQB", gate, due, len(c)) + c for c in commands)
        if self.line.link.send_batch(batch) == 0:
            self.motion += commands

    @rule()
    def send_urgent(self) -> None:
        """Forget what has not been seen on the wire; what was seen must still arrive, and then the stop."""
        if self.line.link.send_urgent(STOP):
            return
        self.damages.clear()
        self.line.run()
        executed = self.line.node.executed
        assert executed[-1] == STOP
        assert executed.count(STOP) == 1
        executed.remove(STOP)
        control, motion = self.split()
        assert self.control[: len(control)] == control
        assert self.motion[: len(motion)] == motion
        self.control, self.motion = control, motion

    @rule(way=st.integers(0, 1), name=st.sampled_from(NAMES))
    def damage_next(self, way: int, name: str) -> None:
        self.damages.append((way, name))

    @rule(time_ms=st.integers(1, 300))
    def pass_time(self, time_ms: int) -> None:
        end_ns = self.line.now + time_ms * MS
        while self.line.now < end_ns and self.line.step():
            pass

    def split(self) -> tuple[list[bytes], list[bytes]]:
        """What was executed, by queue: the numbers of control commands are even."""
        executed = self.line.node.executed
        control = [c for c in executed if read_vlq(c, 1)[0] % 2 == 0]
        return control, [c for c in executed if read_vlq(c, 1)[0] % 2]

    @invariant()
    def nothing_twice_nothing_out_of_order(self) -> None:
        if not hasattr(self, "line"):
            return
        control, motion = self.split()
        assert self.control[: len(control)] == control
        assert self.motion[: len(motion)] == motion

    def teardown(self) -> None:
        if not hasattr(self, "line"):
            return
        self.damages.clear()
        self.line.run()
        assert len(self.line.node.executed) == len(self.control) + len(self.motion)
        assert self.line.link.pending() == 0
        self.nothing_twice_nothing_out_of_order()


LinkMachine.TestCase.settings = settings(max_examples=examples(60), stateful_step_count=40)
TestLink = LinkMachine.TestCase

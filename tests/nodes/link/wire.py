"""A CAN bus under virtual time: the C core of the bus, twin nodes, and a wire that takes what frames last.

The wire is slow, obvious and deterministic: one frame at a time, the lowest id that waits goes next, and a
frame takes its true number of bits.
"""

import heapq
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from nodes.link._link import ffi, lib
from nodes.virtual._hub import lib as hub
from tests.nodes.link.peers import FRAME, pack_frame
from tests.nodes.link.plain import plain
from tests.nodes.link.twin import NodeTwin
from tests.wire_twin import block

MS = 1_000_000
S = 1_000_000_000
NEVER = 2**64 - 1
HZ = 1_000_000
"""Of the nodes' clocks, which read 0 at time 0."""


@dataclass
class Node:
    """A twin with its link, and when what it executed arrived."""

    nodeid: int
    number: int
    twin: NodeTwin
    out: deque[bytes] = field(default_factory=deque)
    arrivals: dict[bytes, int] = field(default_factory=dict)


class Wire:
    """The bus; drive it with run()."""

    def __init__(
        self, nodes: int, bitrate: int = 500_000, *, queue_frames: int = 0, known_bitrate: int | None = None
    ) -> None:
        self.now = S
        self.bitrate = bitrate
        self.host: deque[bytes] = deque()
        self.host_most = 0
        self.refuse_until_ns = 0
        self.bits_by_id: dict[int, int] = {}
        self.order: list[int] = []
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._count = 0
        self._on_wire: tuple[int, bytes] | None = None
        self._end_ns = 0
        known = bitrate if known_bitrate is None else known_bitrate
        settings = ffi.new("struct io_settings *", {"bitrate": known, "queue_frames": queue_frames})
        self._callbacks = (
            ffi.callback("uint64_t(void *)", lambda _: self.now),
            ffi.callback("void(void *)", lambda _: None),
        )
        now, nothing = self._callbacks
        driver = ffi.new("struct io_driver *", [now, nothing, nothing, nothing, nothing, ffi.NULL])
        self.c: Any = lib.io_new(lib.IO_CAN_STREAM, settings, driver, ffi.NULL)
        self._out = ffi.new("uint8_t[]", lib.IO_OUT_FRAMES * FRAME.size)
        self._responses = ffi.new("struct io_event[]", 512)
        self.nodes = {i: self._open(i) for i in range(4, 4 + nodes)}

    def close(self) -> None:
        lib.io_free(self.c)

    def _open(self, nodeid: int) -> Node:
        number = ffi.new("uint32_t *")
        settings = ffi.new("struct link_settings *", (192, 10 * S))
        assert lib.io_open_link(self.c, nodeid, settings, number) == lib.IO_OK
        assert lib.io_set_clock(self.c, number[0], float(HZ), 0, 0) == lib.IO_OK
        return Node(nodeid, number[0], NodeTwin())

    # ------------------------------------------------------------------------------- what the host does

    def send(self, node: Node, content: bytes, *, bulk: bool = False) -> int:
        kind = lib.LINK_BULK if bulk else lib.LINK_CONTROL
        status: int = lib.io_send(self.c, node.number, kind, content, len(content), 0, 0)
        return status

    def send_batch(self, node: Node, batch: bytes) -> int:
        status: int = lib.io_send_batch(self.c, node.number, batch, len(batch))
        return status

    def forecast(self) -> Any:
        out: Any = ffi.new("struct io_forecast *")
        lib.io_forecast(self.c, out)
        return plain(out)

    def stats(self) -> Any:
        out: Any = ffi.new("struct io_stats *")
        lib.io_get_stats(self.c, out)
        return plain(out)

    def link_stats(self, node: Node) -> Any:
        out: Any = ffi.new("struct io_link_stats *")
        assert lib.io_get_link_stats(self.c, node.number, out) == lib.IO_OK
        return plain(out)

    # ----------------------------------------------------------------------------------------- the wire

    def at(self, when_ns: int, action: Callable[[], None]) -> None:
        self._count += 1
        heapq.heappush(self._events, (when_ns, self._count, action))

    def every(self, period_ns: int, action: Callable[[], object], first_ns: int | None = None) -> None:
        """Repeat ACTION for ever."""

        def again() -> None:
            action()
            self.at(self.now + period_ns, again)

        self.at(self.now if first_ns is None else first_ns, again)

    def report(self, node: Node, content: bytes) -> None:
        """Let NODE send a response by itself."""
        self._answer(node, block(node.twin.expected, content))

    def _answer(self, node: Node, data: bytes) -> None:
        for at in range(0, len(data), 8):
            node.out.append(pack_frame(0x101 + 2 * node.nodeid, data[at : at + 8]))

    def _pump_host(self) -> None:
        lib.io_handle_time(self.c, self.now)
        while self.now >= self.refuse_until_ns:
            waiting = len(self.host) + (self._on_wire is not None and not self._on_wire[0])
            size = lib.io_next(self.c, self.now, waiting, self._out, len(self._out))
            if not size:
                break
            data = bytes(ffi.buffer(self._out)[:size])
            self.host += [data[at : at + FRAME.size] for at in range(0, size, FRAME.size)]
            self.host_most = max(self.host_most, waiting + size // FRAME.size)
        while lib.io_take(self.c, self._responses, 512) == 512:
            pass

    def _start_frame(self) -> None:
        queues = [(0, self.host)] + [(node.nodeid, node.out) for node in self.nodes.values()]
        waiting = [(FRAME.unpack(queue[0])[0], sender, queue) for sender, queue in queues if queue]
        if self._on_wire or not waiting:
            return
        can_id, sender, queue = min(waiting)
        record = queue.popleft()
        _, size, data = FRAME.unpack(record)
        bits: int = hub.can_frame_bits(can_id, size, data)
        self.bits_by_id[can_id] = self.bits_by_id.get(can_id, 0) + bits
        self._on_wire = sender, record
        self._end_ns = self.now + bits * S // self.bitrate

    def _end_frame(self) -> None:
        assert self._on_wire
        sender, record = self._on_wire
        self._on_wire = None
        if sender:
            lib.io_received(self.c, record, len(record), self.now)
            return
        can_id, size, data = FRAME.unpack(record)
        self.order.append(can_id)
        node = self.nodes.get((can_id - 0x100) // 2)
        if node:
            before = len(node.twin.executed)
            for answer in node.twin.receive(data[:size]):
                self._answer(node, answer)
            for command in node.twin.executed[before:]:
                node.arrivals[command] = self.now

    def run(self, until_ns: int) -> None:
        while self.now < until_ns:
            self._pump_host()
            self._start_frame()
            deadline_ns = lib.io_deadline(self.c, self.now)
            assert deadline_ns > self.now, "a deadline that has passed would spin"
            next_ns = min(until_ns, max(deadline_ns, self.refuse_until_ns))
            if self._on_wire:
                next_ns = min(next_ns, self._end_ns)
            if self._events:
                next_ns = min(next_ns, self._events[0][0])
            self.now = max(next_ns, self.now)
            while self._events and self._events[0][0] <= self.now:
                heapq.heappop(self._events)[2]()
            if self._on_wire and self._end_ns <= self.now:
                self._end_frame()

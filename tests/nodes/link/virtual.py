"""The C link and the twin node joined by a faulty line, under virtual time."""

import heapq
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from nodes.link._link import ffi, lib
from tests.nodes.link.plain import plain
from tests.nodes.link.twin import NodeTwin, WindowObserver

MS = 1_000_000
NEVER = 2**64 - 1
TO_NODE, TO_HOST = 0, 1
QUEUE = 8192
MOTION_QUEUE = 65536

Delivery = tuple[int, bytes]
"""(further delay in ns, bytes)"""
Fault = Callable[[int, int, bytes], Iterable[Delivery]]
"""(direction, index of the block in it, block) -> what the line makes of it."""


def no_fault(direction: int, index: int, data: bytes) -> Iterable[Delivery]:
    return [(0, data)]


class CoreLink:
    """The C struct with Python's manners."""

    def __init__(self, window: int = 192, lost_after_ns: int = 1000 * MS) -> None:
        settings = ffi.new(
            "struct link_settings *", {"receive_window": window, "lost_after_ns": lost_after_ns}
        )
        sizes = {lib.LINK_MOTION: MOTION_QUEUE, lib.LINK_CONTROL: QUEUE, lib.LINK_BULK: QUEUE}
        self._memory = {kind: ffi.new("uint8_t[]", size) for kind, size in sizes.items()}
        memories = ffi.new("struct link_memory[]", lib.LINK_CLASSES)
        for kind, size in sizes.items():
            memories[kind].at, memories[kind].size = self._memory[kind], size
        self._out = ffi.new("uint8_t[]", lib.LINK_WIRE_MAX)
        self._response: Any = ffi.new("struct link_response *")
        self.c: Any = ffi.new("struct link *")
        lib.link_init(self.c, settings, memories)

    def send(
        self, content: bytes, min_clock: int = 0, req_clock: int = 0, *, now: int = 0, bulk: bool = False
    ) -> int:
        kind = lib.LINK_BULK if bulk else lib.LINK_CONTROL
        status: int = lib.link_send(self.c, kind, content, len(content), min_clock, req_clock, now)
        return status

    def send_batch(self, batch: bytes) -> int:
        status: int = lib.link_send_batch(self.c, batch, len(batch))
        return status

    def send_urgent(self, content: bytes) -> int:
        status: int = lib.link_send_urgent(self.c, content, len(content), 0)
        return status

    def set_clock(self, freq_hz: float, at_ns: int, at_ticks: int) -> int:
        status: int = lib.link_set_clock(self.c, freq_hz, at_ns, at_ticks)
        return status

    def receive(self, data: bytes, now: int) -> list[tuple[bytes, int]]:
        """Return (content, sent_ns) of each response."""
        keep = ffi.from_buffer(data)
        at, size = ffi.new("uint8_t **", keep), ffi.new("size_t *", len(data))
        found = []
        while lib.link_receive(self.c, ffi.cast("const uint8_t **", at), size, now, self._response):
            content = bytes(ffi.buffer(self._response.content)[: self._response.size])
            assert self._response.received_ns == now
            found.append((content, self._response.sent_ns))
        assert size[0] == 0
        return found

    def next_block(self, now: int) -> bytes:
        size = lib.link_next_block(self.c, now, lib.LINK_ALL, self._out)
        return bytes(ffi.buffer(self._out)[:size])

    def handle_timer(self, now: int) -> None:
        lib.link_handle_timer(self.c, now)

    def deadline(self, now: int) -> int:
        at_ns: int = lib.link_deadline(self.c, now, lib.LINK_ALL)
        return at_ns

    def offer(self, now: int, allowed: int = lib.LINK_ALL) -> tuple[int, int, bool] | None:
        """(class, when it should go, urgent), or None."""
        out: Any = ffi.new("struct link_offer *")
        if not lib.link_next_offer(self.c, now, allowed, out):
            return None
        return out.kind, out.due_ns, bool(out.urgent)

    def pending(self) -> int:
        count: int = lib.link_pending(self.c)
        return count

    @property
    def stats(self) -> Any:
        out = ffi.new("struct link_stats *")
        lib.link_get_stats(self.c, out)
        return plain(out)

    @property
    def lost(self) -> bool:
        return bool(self.c.state == lib.LINK_LOST)


@dataclass
class Line:
    """Moves time forward from event to event; 1 ms each way."""

    link: CoreLink
    node: NodeTwin
    fault: Fault = no_fault
    delay_ns: int = MS
    block_ns: int = 0
    """What each block occupies the line for."""
    now: int = 1_000 * MS
    observer: WindowObserver | None = None
    responses: list[tuple[bytes, int]] = field(default_factory=list)
    sent: list[bytes] = field(default_factory=list)
    counts: list[int] = field(default_factory=lambda: [0, 0])
    _events: list[tuple[int, int, int, bytes]] = field(default_factory=list)
    _order: int = 0
    _free_ns: list[int] = field(default_factory=lambda: [0, 0])

    def put(self, direction: int, data: bytes) -> None:
        """Hand DATA to the line; a delayed delivery delays what comes behind it (bytes do not overtake)."""
        index = self.counts[direction]
        self.counts[direction] += 1
        for delay_ns, faulty in self.fault(direction, index, data):
            self._order += 1
            at_ns = max(self.now + self.delay_ns + delay_ns, self._free_ns[direction])
            self._free_ns[direction] = at_ns + self.block_ns
            heapq.heappush(self._events, (at_ns, self._order, direction, faulty))

    def pump(self) -> None:
        """Let the host do all it can do now."""
        self.link.handle_timer(self.now)
        while data := self.link.next_block(self.now):
            self.sent.append(data)
            if self.observer:
                self.observer.sent(data)
            self.put(TO_NODE, data)
        deadline_ns = self.link.deadline(self.now)
        assert deadline_ns > self.now, "a deadline that has passed would spin"

    def step(self) -> bool:
        """Go on to the next event; False: nothing will ever happen."""
        self.pump()
        arrival_ns = self._events[0][0] if self._events else NEVER
        next_ns = min(arrival_ns, self.link.deadline(self.now))
        if next_ns == NEVER:
            return False
        self.now = next_ns
        while self._events and self._events[0][0] <= self.now:
            _, _, direction, data = heapq.heappop(self._events)
            if direction == TO_NODE:
                for answer in self.node.receive(data):
                    self.put(TO_HOST, answer)
            else:
                if self.observer:
                    self.observer.received(data)
                self.responses += self.link.receive(data, self.now)
        self.responses += self.link.receive(b"", self.now)
        return True

    def run(self, until_ns: int = NEVER, limit_ns: int = 60_000 * MS) -> None:
        """Run until nothing is left to do (or until a time); a conversation that does not end fails."""
        end_ns = self.now + limit_ns
        self.pump()
        while (self.link.pending() or self._events) and self.now < until_ns and self.step():
            assert self.now < end_ns, "the conversation does not end"

"""A bus that the test drives: real links in C, twin nodes at the far end, time that only the test moves."""

from collections.abc import Callable
from typing import Any

from nodes.link._link import ffi, lib
from tests.nodes.link.peers import FRAME, pack_frame
from tests.nodes.link.twin import NodeTwin

START_NS = 1_000_000_000
FRAME_NS = 130_000
"""A full CAN frame at 1 Mbit/s; on a serial line what each write is given."""
LIMIT_NS = 60_000_000_000
"""Virtual time after which a conversation counts as one that does not end."""


class ByHand:
    """A driver that moves nothing by itself. BITRATE in bit/s, 0: not known, nothing is budgeted."""

    name = "by hand"
    ffi = ffi
    lib = lib

    def __init__(self, *, serial: bool = True, bitrate: int = 0) -> None:
        self.serial = serial
        self.now = START_NS
        self.noticed = self.closed = 0
        self.handler: Callable[[], None] | None = None
        self.frames: list[tuple[int, bytes]] = []
        """What went to the far end of a CAN bus: (id, data)."""
        self._out = ffi.new("uint8_t[]", lib.IO_OUT_FRAMES * FRAME.size)
        self._callbacks = (
            ffi.callback("uint64_t(void *)", lambda _: self.now),
            ffi.callback("void(void *)", lambda _: None),
            ffi.callback("void(void *)", self._note),
        )
        now, nothing, note = self._callbacks
        driver = ffi.new("struct io_driver *", [now, nothing, nothing, nothing, note, ffi.NULL])
        settings = ffi.new("struct io_settings *", {"bitrate": bitrate})
        kind = lib.IO_BYTES if serial else lib.IO_CAN_STREAM
        self.bus: Any = lib.io_new(kind, settings, driver, ffi.NULL)

    def _note(self, _: object) -> None:
        self.noticed += 1

    def listen(self, handler: Callable[[], None]) -> None:
        self.handler = handler

    def close(self) -> None:
        self.closed += 1
        lib.io_free(self.bus)

    def hand_over(self) -> None:
        """Let Python take what has arrived."""
        assert self.handler
        self.handler()

    def receive(self, data: bytes) -> None:
        """Let DATA arrive from the far end now: serial bytes, or records of CAN frames."""
        lib.io_received(self.bus, data, len(data), self.now)
        lib.io_handle_time(self.bus, self.now)

    def exchange(self, nodes: dict[int, NodeTwin], done: Callable[[], bool]) -> None:
        """Let the host and NODES (by node id; a serial line's is 0) talk until DONE."""
        end_ns = self.now + LIMIT_NS
        while not done():
            assert self.now < end_ns, "the conversation does not end"
            if size := lib.io_next(self.bus, self.now, 0, self._out, len(self._out)):
                self._deliver(bytes(ffi.buffer(self._out)[:size]), nodes)
                continue
            deadline_ns = lib.io_deadline(self.bus, self.now)
            assert deadline_ns < 1 << 63, "nothing will ever happen"
            self.now = max(deadline_ns, self.now + 1)
            lib.io_handle_time(self.bus, self.now)

    def _deliver(self, data: bytes, nodes: dict[int, NodeTwin]) -> None:
        if self.serial:
            self.now += FRAME_NS
            for answer in nodes[0].receive(data):
                self.receive(answer)
            return
        for can_id, size, payload in FRAME.iter_unpack(data):
            self.now += FRAME_NS
            self.frames.append((can_id, payload[:size]))
            node = nodes.get((can_id - 0x100) // 2)
            for answer in node.receive(payload[:size]) if node else ():
                for at in range(0, len(answer), 8):
                    self.receive(pack_frame(can_id + 1, answer[at : at + 8]))

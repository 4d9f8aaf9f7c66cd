"""The other end of a transport: twin nodes behind a socket, served by the test's own asyncio loop."""

import asyncio
import contextlib
import os
import socket
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from nodes.link import Frame, Link, LinkIO, LinkSettings, Response, TransportKind
from tests.nodes.link.twin import NodeTwin

FRAME = struct.Struct("=IB3x8s")
TIMEOUT_S = 20.0


def pack_frame(can_id: int, data: bytes) -> bytes:
    return FRAME.pack(can_id, len(data), data)


@dataclass
class SocketTransport:
    """The least that is a transport."""

    name: str
    kind: TransportKind
    socket: socket.socket

    def fileno(self) -> int:
        return self.socket.fileno()

    def close(self) -> None:
        self.socket.close()


@dataclass
class FdTransport:
    """A transport that is a bare file descriptor."""

    name: str
    kind: TransportKind
    fd: int

    def fileno(self) -> int:
        return self.fd

    def close(self) -> None:
        os.close(self.fd)


class Peer:
    """Twin nodes by node id (0 on a serial line) at the far end."""

    def __init__(self, kind: TransportKind, end: socket.socket, nodes: dict[int, NodeTwin]) -> None:
        self.kind = kind
        self.end = end
        self.nodes = nodes
        self.frames: list[tuple[int, bytes]] = []
        self.frame_arrived = asyncio.Event()
        self.order: list[int] = []
        self._rest = b""
        self._unsent: list[bytes] = []
        end.setblocking(False)
        self.listen()

    def listen(self) -> None:
        asyncio.get_running_loop().add_reader(self.end, self._handle_readable)

    def deafen(self) -> None:
        """Stop reading until listen()."""
        asyncio.get_running_loop().remove_reader(self.end)

    def close(self) -> None:
        self.deafen()
        asyncio.get_running_loop().remove_writer(self.end)
        self.end.close()

    def _handle_readable(self) -> None:
        data = self.end.recv(65536)
        if not data:
            self.close()
        elif self.kind == TransportKind.BYTES:
            for answer in self.nodes[0].receive(data):
                self.send(answer)
        else:
            data = self._rest + data
            whole = len(data) // FRAME.size * FRAME.size
            self._rest = data[whole:]
            for can_id, size, payload in FRAME.iter_unpack(data[:whole]):
                self._handle_frame(can_id, payload[:size])

    def _handle_frame(self, can_id: int, data: bytes) -> None:
        self.frames.append((can_id, data))
        self.frame_arrived.set()
        node = self.nodes.get((can_id - 0x100) // 2)
        if node is None:
            return
        self.order.append((can_id - 0x100) // 2)
        for answer in node.receive(data):
            for at in range(0, len(answer), 8):
                self.send(pack_frame(can_id + 1, answer[at : at + 8]))

    def send(self, data: bytes) -> None:
        self._unsent.append(data)
        self._flush()

    def _flush(self) -> None:
        loop = asyncio.get_running_loop()
        while self._unsent:
            try:
                done = self.end.send(self._unsent[0])
            except BlockingIOError:
                loop.add_writer(self.end, self._flush)
                return
            self._unsent[0] = self._unsent[0][done:]
            if not self._unsent[0]:
                self._unsent.pop(0)
        loop.remove_writer(self.end)


class Inbox:
    """Collects what a link hands over and lets a test wait for it."""

    def __init__(self) -> None:
        self.responses: list[Response] = []
        self.frames: list[Frame] = []
        self.lost: list[str] = []
        self.closed: list[str] = []
        self._changed = asyncio.Event()

    def on_responses(self, responses: Sequence[Response]) -> None:
        self.responses += responses
        self._changed.set()

    def on_frame(self, frame: Frame) -> None:
        self.frames.append(frame)
        self._changed.set()

    def on_lost(self, text: str) -> None:
        self.lost.append(text)
        self._changed.set()

    def on_closed(self, text: str) -> None:
        self.closed.append(text)
        self._changed.set()

    async def until(self, condition: Callable[[], object]) -> None:
        async with asyncio.timeout(TIMEOUT_S):
            while not condition():
                self._changed.clear()
                await self._changed.wait()


@dataclass
class Bench:
    io: LinkIO
    peer: Peer
    inbox: Inbox

    def open(self, nodeid: int, lost_after_s: float = 10.0) -> Link:
        settings = LinkSettings(nodeid or None, lost_after_s=lost_after_s, ahead_s=0.0)
        return self.io.open_link(settings, on_responses=self.inbox.on_responses, on_lost=self.inbox.on_lost)


@contextlib.contextmanager
def bench(kind: TransportKind, nodes: dict[int, NodeTwin], *, small_buffers: bool = False) -> Iterator[Bench]:
    """Join a LinkIO to twin nodes by a socket pair."""
    packets = kind == TransportKind.CAN_PACKET
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET if packets else socket.SOCK_STREAM)
    if small_buffers:
        for end in ours, theirs:
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
    transport = SocketTransport("pair", kind, ours)
    inbox = Inbox()
    peer = Peer(kind, theirs, nodes)
    loop = asyncio.get_running_loop()
    io = LinkIO(transport, loop, on_frame=inbox.on_frame, on_closed=inbox.on_closed)
    try:
        yield Bench(io, peer, inbox)
    finally:
        io.close()
        transport.close()
        if peer.end.fileno() >= 0:
            peer.close()


def open_files() -> int:
    """How many file descriptors this process has open."""
    return sum(1 for _ in Path("/proc/self/fd").iterdir())

"""Transport over any backend of python-can: two threads pass frames between its Bus and a socket pair.

The C thread of the link needs a file descriptor, and most backends have none that it could read. Memory is
bounded: what one side does not read waits in the socket pair, and then in the backend.
"""

import contextlib
import socket
import threading
from typing import Any, Self

import can

from nodes.support.errors import CanductorError
from nodes.transport.base import TransportClosedError
from nodes.transport.frame import ID_MAX, RECORD_SIZE, CanFrame
from nodes.transport.stream import SEND_BUFFER, RecordStream

_POLL_S = 0.1
"""Interval at which the receiving thread checks whether to end: backends cannot be woken."""
_BUS_SEND_TIMEOUT_S = 1.0


class PythonCanBridge(RecordStream):
    """A CAN transport over BUS, which it owns. An error of the bus ends it: see ``cause``."""

    def __init__(self, bus: can.BusABC, name: str, *, bitrate: int | None = None) -> None:
        """Start the two threads."""
        ours, peer = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        super().__init__(ours, name, bitrate=bitrate)
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        self._bus = bus
        self._peer = peer
        self._ending = threading.Event()
        self._abandoned = threading.Event()  # frames that still wait are dropped
        self._cause: CanductorError | None = None
        self.dropped = 0
        """Received frames other than data frames with an 11-bit id."""
        self._threads = [
            threading.Thread(target=target, name=f"{name} {way}", daemon=True)
            for target, way in ((self._pass_from_bus, "receiver"), (self._pass_to_bus, "sender"))
        ]
        for thread in self._threads:
            thread.start()

    @classmethod
    def open(cls, interface: str, channel: str, *, bitrate: int | None = None) -> Self:
        """Open python-can's backend INTERFACE on CHANNEL; raises CanductorError."""
        name = f"{interface}:{channel}"
        options: dict[str, Any] = {} if bitrate is None else {"bitrate": bitrate}
        try:
            bus = can.Bus(channel=channel, interface=interface, **options)
        except CanductorError:
            raise
        # Backends raise what their vendors' libraries raise: these have no common type.
        except Exception as error:
            raise CanductorError(
                f"CAN bus {name}: python-can cannot open it ({error}); backends are listed at"
                " python-can.readthedocs.io/en/stable/configuration.html, and some need a driver"
            ) from error
        return cls(bus, name, bitrate=bitrate)

    @property
    def cause(self) -> CanductorError | None:
        """The error that ended the bridge; None while it works, or when close() ended it."""
        return self._cause

    def why_closed(self) -> str:
        """Return the error of the backend."""
        return str(self._cause or "the bridge was closed")

    def close(self) -> None:
        """Send what still waits if the bus accepts it, then shut the bus down; at most a few seconds."""
        if self._socket is None:
            return
        self._ending.set()
        super().close()
        self._threads[1].join(_BUS_SEND_TIMEOUT_S)  # the sender ends when it has read everything
        self._end()
        for thread in self._threads:
            thread.join(2 * _BUS_SEND_TIMEOUT_S)  # a backend that hangs must not block this
        self._peer.close()
        self._bus.shutdown()

    def _end(self, error: Exception | None = None) -> None:
        """End both threads, and the stream for the user. May be called from any thread."""
        if error is not None and self._cause is None and not self._ending.is_set():
            self._cause = TransportClosedError(f"CAN bus {self.name}: the backend failed: {error}")
        self._ending.set()
        self._abandoned.set()
        with contextlib.suppress(OSError):
            self._peer.shutdown(socket.SHUT_RDWR)

    def _pass_from_bus(self) -> None:
        try:
            while not self._ending.is_set():
                message = self._bus.recv(_POLL_S)
                if message is None:
                    continue
                if is_plain(message):
                    self._peer.sendall(CanFrame(message.arbitration_id, bytes(message.data)).to_record())
                else:
                    self.dropped += 1
        except BrokenPipeError:
            pass  # close() was called
        # Whatever a backend raises ends the bridge and is reported.
        except Exception as error:  # noqa: BLE001
            self._end(error)

    def _pass_to_bus(self) -> None:
        received = b""
        try:
            while data := self._peer.recv(64 * RECORD_SIZE):
                received += data
                end = len(received) - len(received) % RECORD_SIZE
                for at in range(0, end, RECORD_SIZE):
                    if self._abandoned.is_set():
                        return
                    if frame := CanFrame.from_record(received[at : at + RECORD_SIZE]):
                        self._bus.send(to_message(frame), _BUS_SEND_TIMEOUT_S)
                received = received[end:]
        except ConnectionResetError:
            pass  # close() was called with frames unread
        except Exception as error:  # noqa: BLE001
            self._end(error)


def is_plain(message: can.Message) -> bool:
    """Return whether MESSAGE is a CAN 2.0A data frame."""
    special = message.is_extended_id or message.is_remote_frame or message.is_error_frame or message.is_fd
    return not special and message.arbitration_id <= ID_MAX


def to_message(frame: CanFrame) -> can.Message:
    """Return FRAME as a message of python-can."""
    return can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False)

"""Records of CAN frames over a stream socket, for the virtual bus and the python-can bridge."""

import select
import socket
import time

from nodes.link.types import TransportKind
from nodes.transport.base import SEND_TIMEOUT_S, TransportBusyError, TransportClosedError
from nodes.transport.frame import RECORD_SIZE, CanFrame

SEND_BUFFER = 16_384
"""Bytes requested for the kernel's send buffer: some 40 frames sent one by one. Enough to keep a bus busy for
milliseconds; more would only delay the frames sent last."""
READ_SIZE = 256 * RECORD_SIZE


def wait_for(fd: int, event: int, timeout_s: float) -> bool:
    """Wait until poll() reports EVENT (or an error, or the end) for FD; False after the timeout."""
    poller = select.poll()
    poller.register(fd, event)
    return bool(poller.poll(max(0.0, timeout_s) * 1000))


class RecordStream:
    """A CAN transport (kind CAN_STREAM) over the connected stream socket SOCK, which it owns."""

    kind = TransportKind.CAN_STREAM

    def __init__(
        self, sock: socket.socket, name: str, *, bitrate: int | None = None, read_size: int = READ_SIZE
    ) -> None:
        """Use SOCK. NAME is for messages, BITRATE for budgeting bandwidth.

        READ_SIZE: bytes to read at once. With RECORD_SIZE no frame is ever buffered here while the file
        descriptor is not readable, as users that wait for it (asyncio) need.
        """
        self.name = name
        self._read_size = read_size
        self.bitrate = bitrate
        self._socket: socket.socket | None = sock
        self._received = bytearray()
        self._unsent = b""
        sock.setblocking(False)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)

    def fileno(self) -> int:
        """Return the socket's file descriptor."""
        return self._open_socket().fileno()

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def why_closed(self) -> str:
        """Return why the other end is gone; transports that know more override it."""
        return "the other end closed the connection; is its process still running?"

    def send(self, frame: CanFrame, timeout_s: float = SEND_TIMEOUT_S) -> None:
        """See CanTransport.send()."""
        deadline_s = time.monotonic() + timeout_s
        # A record that the kernel accepted only in part is completed before the next one begins.
        while self._unsent:
            self._unsent = self._unsent[self._send_some(self._unsent, deadline_s) :]
        record = frame.to_record()
        self._unsent = record[self._send_some(record, deadline_s) :]

    def _send_some(self, data: bytes, deadline_s: float) -> int:
        sock = self._open_socket()
        while True:
            try:
                return sock.send(data, socket.MSG_NOSIGNAL)
            except BlockingIOError:
                if not wait_for(sock.fileno(), select.POLLOUT, deadline_s - time.monotonic()):
                    raise TransportBusyError(
                        f"{self.name}: frames are not accepted; a client of the bus may have stopped reading"
                    ) from None
            except OSError as error:
                raise TransportClosedError(f"{self.name}: {self.why_closed()}") from error

    def receive(self, timeout_s: float) -> CanFrame | None:
        """See CanTransport.receive()."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            while len(self._received) >= RECORD_SIZE:
                record = bytes(self._received[:RECORD_SIZE])
                del self._received[:RECORD_SIZE]
                if frame := CanFrame.from_record(record):
                    return frame
            if not self._fill(deadline_s):
                return None

    def _fill(self, deadline_s: float) -> bool:
        """Read what has arrived; False when nothing arrives until the deadline."""
        sock = self._open_socket()
        try:
            data = sock.recv(self._read_size - len(self._received))
        except BlockingIOError:
            # After the deadline poll() only checks, and the caller's next call returns.
            return wait_for(sock.fileno(), select.POLLIN, deadline_s - time.monotonic())
        except OSError as error:
            raise TransportClosedError(f"{self.name}: {self.why_closed()}") from error
        if not data:
            raise TransportClosedError(f"{self.name}: {self.why_closed()}")
        self._received += data
        return True

    def _open_socket(self) -> socket.socket:
        if self._socket is None:
            raise TransportClosedError(f"{self.name}: already closed by this program")
        return self._socket

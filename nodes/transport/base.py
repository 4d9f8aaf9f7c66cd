"""What a transport is: a file descriptor that carries CAN frames or bytes, and a few words about it.

The link's C thread reads and writes the file descriptor itself; it needs ``kind`` to know how. ``send`` and
``receive`` are for simple users in Python (tools, tests) and must not be mixed with a C thread at work on the
same transport. Neither ever blocks for longer than its timeout.
"""

from enum import IntEnum
from typing import Protocol

from nodes.support.errors import CanductorError
from nodes.transport.frame import CanFrame

SEND_TIMEOUT_S = 1.0


class TransportKind(IntEnum):
    """How the file descriptor carries what it carries; the link's C code knows these numbers."""

    CAN_STREAM = 0
    """A stream socket of 16-byte ``struct can_frame`` records; a read may end within one."""
    CAN_PACKET = 1
    """One 16-byte record per read and per write: SocketCAN, or a socket that keeps packets apart."""
    BYTES = 2
    """A plain byte stream: a UART."""


class TransportClosedError(CanductorError):
    """The other end is gone, or close() was called."""


class TransportBusyError(CanductorError):
    """Nothing could be sent within the timeout: the other end does not take it."""


class Transport(Protocol):
    """Part common to all transports. The file descriptor does not block."""

    @property
    def name(self) -> str:
        """For messages: what it is and where, as the user wrote it."""

    @property
    def kind(self) -> TransportKind:
        """How to read and write the file descriptor."""

    @property
    def bitrate(self) -> int | None:
        """Bits per second, None when unknown or without limit."""

    def fileno(self) -> int:
        """Return the file descriptor; it stays the transport's. Raises TransportClosedError after close()."""

    def close(self) -> None:
        """Let go of the device; the other end sees it. Doing it again is harmless."""


class CanTransport(Transport, Protocol):
    """A transport of kind CAN_STREAM or CAN_PACKET."""

    def send(self, frame: CanFrame, timeout_s: float = SEND_TIMEOUT_S) -> None:
        """Send FRAME; raises TransportBusyError (and sent nothing) or TransportClosedError."""

    def receive(self, timeout_s: float) -> CanFrame | None:
        """Return the next data frame with an 11-bit id, None after the timeout.

        Others are dropped. Raises TransportClosedError, but only after the last frame was returned.
        """


class ByteTransport(Transport, Protocol):
    """A transport of kind BYTES."""

    def send(self, data: bytes, timeout_s: float = SEND_TIMEOUT_S) -> int:
        """Send the front of DATA, return how many bytes (> 0); errors as for CanTransport."""

    def receive(self, timeout_s: float) -> bytes | None:
        """Return what has come (not empty), None after the timeout; errors as for CanTransport."""

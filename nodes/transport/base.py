"""Interface of a transport: a file descriptor that carries CAN frames or bytes, and its properties.

The link's C thread reads and writes the file descriptor itself, as ``kind`` states. ``send`` and ``receive``
are for simple users in Python (tools, tests) and must not be used while a C thread uses the same transport.
Neither blocks for longer than its timeout.
"""

from typing import Protocol

from nodes.link.types import LinkTransport
from nodes.support.errors import CanductorError
from nodes.transport.frame import CanFrame

SEND_TIMEOUT_S = 1.0


class TransportClosedError(CanductorError):
    """The other end is gone, or close() was called."""


class TransportBusyError(CanductorError):
    """Nothing could be sent within the timeout: the other end does not read."""


class Transport(LinkTransport, Protocol):
    """Part common to all transports. The file descriptor does not block.

    fileno() raises TransportClosedError after close(), which may be called again.
    """

    @property
    def bitrate(self) -> int | None:
        """Bits per second, None when unknown or without limit."""


class CanTransport(Transport, Protocol):
    """A transport of kind CAN_STREAM or CAN_PACKET."""

    def send(self, frame: CanFrame, timeout_s: float = SEND_TIMEOUT_S) -> None:
        """Send FRAME; raises TransportBusyError (nothing was sent) or TransportClosedError."""

    def receive(self, timeout_s: float) -> CanFrame | None:
        """Return the next data frame with an 11-bit id, None after the timeout.

        Other frames are dropped. Raises TransportClosedError, but only after the last frame was returned.
        """


class ByteTransport(Transport, Protocol):
    """A transport of kind BYTES."""

    def send(self, data: bytes, timeout_s: float = SEND_TIMEOUT_S) -> int:
        """Send the first bytes of DATA; return how many (> 0). Errors as for CanTransport."""

    def receive(self, timeout_s: float) -> bytes | None:
        """Return the bytes received (not empty), None after the timeout; errors as for CanTransport."""

"""Transport over a UART (or a USB device or pseudo-terminal that acts like one)."""

import contextlib
import fcntl
import os
import select
import struct
import termios
import time
from pathlib import Path

import serial

from nodes.link.types import TransportKind
from nodes.support.errors import CanductorError
from nodes.transport.base import SEND_TIMEOUT_S, TransportBusyError, TransportClosedError
from nodes.transport.stream import wait_for

BAUD_DEFAULT = 250_000
_READ_SIZE = 4096


class UartTransport:
    """The serial device at PATH: 8 data bits, no parity, 1 stop bit, no flow control, opened exclusively.

    pyserial opens and configures the device; from then on only the file descriptor is used. ``dtr`` and
    ``rts`` are the levels of the control lines (some boards reset when DTR goes up).
    """

    kind = TransportKind.BYTES

    def __init__(
        self, path: str | Path, baud: int = BAUD_DEFAULT, *, dtr: bool = True, rts: bool = True
    ) -> None:
        """Open the device; raises CanductorError."""
        self.name = str(path)
        self.bitrate = baud
        port = serial.Serial()
        port.port = str(path)
        port.exclusive = True
        port.timeout = port.write_timeout = 0
        port.dtr, port.rts = dtr, rts
        try:
            port.baudrate = baud
            port.open()
            _report_empty_reads(port.fd)
            port.reset_input_buffer()
        except (OSError, ValueError, OverflowError, termios.error) as error:  # SerialException is an OSError
            port.close()
            raise _cannot_open(path, baud, error) from error
        # USB adapters otherwise delay received bytes for up to 16 ms; others do not need this.
        with contextlib.suppress(OSError, ValueError, NotImplementedError):
            port.set_low_latency_mode(low_latency_settings=True)
        self._port = port

    def fileno(self) -> int:
        """Return the device's file descriptor."""
        if not self._port.is_open:
            raise TransportClosedError(f"UART {self.name}: already closed by this program")
        return int(self._port.fd)

    @property
    def has_lines(self) -> bool:
        """Whether the device has DTR and RTS; a pseudo-terminal has not."""
        try:
            fcntl.ioctl(self.fileno(), termios.TIOCMGET, bytes(4))
        except OSError:
            return False
        return True

    def set_lines(self, dtr: bool, rts: bool) -> None:
        """Set DTR and RTS; raises CanductorError. The link's thread may use the device meanwhile."""
        try:
            for level, line in ((dtr, termios.TIOCM_DTR), (rts, termios.TIOCM_RTS)):
                request = termios.TIOCMBIS if level else termios.TIOCMBIC
                fcntl.ioctl(self.fileno(), request, struct.pack("I", line))
        except OSError as error:
            raise CanductorError(f"UART {self.name}: cannot set DTR and RTS: {error.strerror}") from error

    def close(self) -> None:
        """Close the device."""
        self._port.close()

    def send(self, data: bytes, timeout_s: float = SEND_TIMEOUT_S) -> int:
        """See ByteTransport.send()."""
        deadline_s = time.monotonic() + timeout_s
        fd = self.fileno()
        while True:
            try:
                return os.write(fd, data)
            except BlockingIOError:
                if not wait_for(fd, select.POLLOUT, deadline_s - time.monotonic()):
                    raise TransportBusyError(f"UART {self.name}: bytes are not accepted") from None
            except OSError as error:
                raise self._gone() from error

    def receive(self, timeout_s: float) -> bytes | None:
        """See ByteTransport.receive()."""
        deadline_s = time.monotonic() + timeout_s
        fd = self.fileno()
        while True:
            try:
                data = os.read(fd, _READ_SIZE)
            except BlockingIOError:
                data = b""
            except OSError as error:  # EIO: the other end of a pseudo-terminal is closed
                raise self._gone() from error
            if data:
                return data
            # A terminal in raw mode with VMIN 0 returns nothing without data, and also after a hang-up.
            if self._hung_up(fd):
                raise self._gone()
            if not wait_for(fd, select.POLLIN, deadline_s - time.monotonic()):
                return None

    @staticmethod
    def _hung_up(fd: int) -> bool:
        poller = select.poll()
        poller.register(fd, 0)  # a hang-up is always reported
        return bool(poller.poll(0))

    def _gone(self) -> TransportClosedError:
        return TransportClosedError(
            f"UART {self.name}: the device is gone; was it unplugged, or its process stopped?"
        )


def _report_empty_reads(fd: int) -> None:
    """Set VMIN to 1: with 0, as pyserial leaves it, reading nothing looks like the end, not like EAGAIN."""
    attributes = termios.tcgetattr(fd)
    characters = attributes[6]
    characters[termios.VMIN], characters[termios.VTIME] = 1, 0
    termios.tcsetattr(fd, termios.TCSANOW, attributes)


def _cannot_open(path: str | Path, baud: int, error: Exception) -> CanductorError:
    where = f"UART {path}: cannot open it at {baud} baud: "
    if isinstance(error, PermissionError) or (isinstance(error, OSError) and error.errno == 13):
        return CanductorError(where + "permission denied; add the user to the group 'dialout'")
    if not os.path.exists(path):  # noqa: PTH110 (Path.exists raises for a name that is too long)
        return CanductorError(where + "there is no such device; list the devices with 'ls /dev/serial/by-id'")
    if isinstance(error, OSError) and "exclusively lock" in str(error):
        return CanductorError(where + "another program uses it; stop that program first")
    return CanductorError(where + f"{error}; is it a serial device, and does it support this rate?")

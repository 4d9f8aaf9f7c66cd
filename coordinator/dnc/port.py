"""The serial line itself: a device, a pseudo-terminal, or a pyserial URL such as socket://HOST:PORT."""

import contextlib
import errno
import os
import queue
import re
import select
import stat
import termios
import threading
from typing import Any, Final

import serial

from coordinator.dnc.options import DncOptions
from nodes.support.errors import CanductorError

READ_SIZE: Final = 4096
_QUEUED_MAX: Final = 256
"""Queue length of a port without a file descriptor, in pieces of READ_SIZE."""
_PSEUDO_MAJORS: Final = range(136, 144)
_IN_TEXT: Final = re.compile(r"(?:\[Errno |\()(-?\d+)(?:\]|,) '?([^')]*)")


class PortError(CanductorError):
    """The port cannot be opened, or was lost."""


class Port:
    """An open line. NAME is a device or a pyserial URL; raises PortError."""

    def __init__(self, name: str, options: DncOptions, rtscts: bool = False) -> None:
        self.name = name
        try:
            self._port: Any = serial.serial_for_url(
                name,
                baudrate=options.baud,
                bytesize=options.frame.data_bits,
                parity=options.frame.parity,
                stopbits=options.frame.stop_bits,
                xonxoff=False,  # it would remove DC1, and check characters of 11 or 13 hex
                rtscts=rtscts,
                timeout=0.05,
                write_timeout=None,
                **({"exclusive": True} if "://" not in name else {}),
            )
        except (OSError, ValueError, OverflowError, termios.error) as error:
            raise PortError(_cannot_open(name, options, error)) from None
        self._fd = _descriptor(self._port)
        self._is_tty = self._fd is not None and os.isatty(self._fd)
        if self._fd is not None and self._is_tty:
            _mark_parity_errors(self._fd, on=options.frame.parity != "N")
            with contextlib.suppress(OSError, ValueError, NotImplementedError, AttributeError):
                self._port.set_low_latency_mode(low_latency_settings=True)
        if self._fd is not None:
            os.set_blocking(self._fd, False)
        self._closing = threading.Event()
        self._read: queue.Queue[bytes | OSError] = queue.Queue(_QUEUED_MAX)
        if self._fd is None:
            self._thread = threading.Thread(target=self._read_on, name="dnc port", daemon=True)
            self._thread.start()

    @property
    def is_paced(self) -> bool:
        """Whether characters are sent at the baud rate; not on sockets, pseudo-terminals and USB modems."""
        if self._fd is None or not self._is_tty:
            return False
        device = os.fstat(self._fd)
        usb_modem = os.path.basename(os.path.realpath(self.name)).startswith("ttyACM")  # noqa: PTH119
        return (
            stat.S_ISCHR(device.st_mode) and os.major(device.st_rdev) not in _PSEUDO_MAJORS and not usb_modem
        )

    def close(self) -> None:
        """Close the port."""
        self._closing.set()
        if self._fd is None:
            self._thread.join(timeout=1.0)
        with contextlib.suppress(OSError):
            self._port.close()

    def read(self, timeout_s: float) -> bytes:
        """Return received bytes, after TIMEOUT_S at most; raises PortError."""
        if self._fd is None:
            return self._read_queue(timeout_s)
        try:
            ready, _, _ = select.select([self._fd], [], [], max(timeout_s, 0.0))
            if not ready:
                return b""
            data = os.read(self._fd, READ_SIZE)
        except BlockingIOError:
            return b""
        except (OSError, ValueError) as error:
            raise PortError(f"{self.name} was lost: {error}; check its plug and start again") from None
        if not data:
            if self._is_tty:
                return b""
            raise PortError(f"{self.name} was closed by the other side; start again when it is available")
        return data

    def write(self, data: bytes, timeout_s: float) -> None:
        """Send DATA; raises PortError when the port has not accepted it within TIMEOUT_S."""
        try:
            if self._fd is None:
                self._port.write(data)
                return
            while data:
                _, ready, _ = select.select([], [self._fd], [], timeout_s)
                if not ready:
                    raise PortError(
                        f"{self.name} has not accepted data for {timeout_s:g} s; check its flow control"
                    )
                with contextlib.suppress(BlockingIOError):
                    data = data[os.write(self._fd, data) :]
        except (OSError, ValueError) as error:
            raise PortError(f"{self.name} was lost: {error}; check its plug and start again") from None

    def _read_queue(self, timeout_s: float) -> bytes:
        try:
            data = self._read.get(timeout=max(timeout_s, 0.0005))
        except queue.Empty:
            return b""
        if isinstance(data, OSError):
            raise PortError(f"{self.name} was lost: {data}; start again when it is available")
        return data

    def _read_on(self) -> None:
        """Read a port that has no file descriptor for select."""
        while not self._closing.is_set():
            try:
                data = self._port.read(1)
                data += self._port.read(min(self._port.in_waiting, READ_SIZE)) if data else b""
            except OSError as error:
                self._put(error)
                return
            if data:
                self._put(data)

    def _put(self, data: bytes | OSError) -> None:
        while not self._closing.is_set():
            with contextlib.suppress(queue.Full):
                self._read.put(data, timeout=0.1)
                return


def _descriptor(port: Any) -> int | None:
    """Return the file descriptor of the port, if it has one."""
    try:
        return int(port.fileno())
    except (AttributeError, OSError, ValueError):
        return None


def _mark_parity_errors(fd: int, *, on: bool) -> None:
    """Read characters with a parity error as NUL, which no block contains; pyserial does not report them."""
    settings = termios.tcgetattr(fd)
    mask = termios.INPCK if on else 0
    settings[0] = (settings[0] & ~(termios.INPCK | termios.PARMRK | termios.IGNPAR)) | mask
    # Without data a read then fails; otherwise it would look like the end.
    settings[6][termios.VMIN] = 1
    settings[6][termios.VTIME] = 0
    termios.tcsetattr(fd, termios.TCSANOW, settings)


def _cannot_open(name: str, options: DncOptions, error: Exception) -> str:
    code, why = _reason(error)
    if "://" in name and code is not None:
        return f"{name} cannot be reached: {why}; check host, port, and that the serial server runs"
    match code:
        case errno.EACCES | errno.EPERM:
            return f"{name} cannot be opened: permission denied; add yourself to the group 'dialout'"
        case errno.ENOENT | errno.ENODEV | errno.ENXIO:
            return f"there is no serial port '{name}'; check its plug ('ls /dev/serial/by-id')"
        case errno.EAGAIN | errno.EBUSY:
            return f"{name} is in use by another program; close that program first"
        case errno.ENOTTY | errno.EISDIR:
            return f"{name} is not a serial port; use a device such as /dev/ttyUSB0, or socket://HOST:PORT"
    settings = f"{options.baud} baud {options.frame}"
    return f"{name} cannot be opened at {settings}: {why}; check name and settings"


def _reason(error: Exception) -> tuple[int | None, str]:
    """Return number and text of ERROR; pyserial sometimes has them only in its own text."""
    text = getattr(error, "strerror", None) or str(error)
    code = getattr(error, "errno", None)
    if (found := _IN_TEXT.search(text)) is not None:
        code, text = int(found[1]), found[2].partition(":")[0]
    return code, text.lower()

"""Transport over SocketCAN: the CAN interfaces of the Linux kernel, ``vcan`` included."""

import contextlib
import errno
import os
import select
import socket
import struct
import time

from nodes.link.types import TransportKind
from nodes.support.errors import CanductorError
from nodes.transport.base import SEND_TIMEOUT_S, TransportBusyError, TransportClosedError
from nodes.transport.frame import RECORD_SIZE, CanFrame
from nodes.transport.stream import wait_for

SEND_BUFFER = 8_192
"""Bytes requested for the kernel's send buffer: fewer frames than the default queue of an interface (10)
holds, so that poll() reports when there is room and sending does not fail with ENOBUFS."""
RECEIVE_BUFFER = 4 << 20
"""Bytes requested for the kernel's receive buffer: half a second of a full bus; unprivileged users get at
most net.core.rmem_max. The default holds some 280 frames, 30 ms of a full bus."""
_RETRY_S = 0.001
# Constants of the kernel that the socket module lacks.
_SO_RCVBUFFORCE = 33
_SO_MEMINFO = 55
_MEMINFO = struct.Struct("=9I")
_MEMINFO_DROPS = 8
_CAN_RAW_ERR_FILTER = 2
_CAN_ERR_BUSOFF = 0x40

_ERRORS = {
    errno.ENODEV: "there is no such interface; list the interfaces with 'ip link show'",
    errno.ENETDOWN: "the interface is down; bring it up with 'ip link set {0} up type can bitrate 1000000'"
    " (a virtual one without 'type …')",
    errno.EAFNOSUPPORT: "this kernel has no CAN; load the module can-raw, or use a virtual bus: virtual:PATH",
    errno.EPROTONOSUPPORT: "this kernel has no raw CAN sockets; load the module can-raw",
    errno.EPERM: "this user may not open CAN sockets",
}


class SocketCanTransport:
    """The data frames with 11-bit ids on the interface INTERFACE ("can0")."""

    kind = TransportKind.CAN_PACKET

    def __init__(self, interface: str, *, bitrate: int | None = None) -> None:
        """Open and bind a socket; raises CanductorError. BITRATE: that of the interface."""
        self.name = interface
        self.bitrate = bitrate
        self._socket: socket.socket | None = None
        try:
            sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except OSError as error:
            raise self._cannot("open", error) from error
        try:
            _configure(sock)
            sock.bind((interface,))
            _require_up(interface)
        except OSError as error:
            sock.close()
            raise self._cannot("open", error) from error
        self._socket = sock

    def _cannot(self, what: str, error: OSError) -> CanductorError:
        advice = _ERRORS.get(error.errno or 0, error.strerror or str(error)).format(self.name)
        return CanductorError(f"CAN interface {self.name}: cannot {what}: {advice}")

    def fileno(self) -> int:
        """Return the socket's file descriptor."""
        return self._open_socket().fileno()

    @property
    def dropped(self) -> int:
        """Number of frames that the kernel dropped because they were not read in time."""
        info = self._open_socket().getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
        return int(_MEMINFO.unpack(info)[_MEMINFO_DROPS])

    def close(self) -> None:
        """Close the socket; the bus itself and its nodes are not affected."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def send(self, frame: CanFrame, timeout_s: float = SEND_TIMEOUT_S) -> None:
        """See CanTransport.send()."""
        deadline_s = time.monotonic() + timeout_s
        sock = self._open_socket()
        while True:
            try:
                sock.send(frame.to_record())
            except OSError as error:
                # ENOBUFS: the interface's own queue is full, which poll() does not report.
                if error.errno not in (errno.EAGAIN, errno.ENOBUFS):
                    raise self._closed(error) from error
                left_s = deadline_s - time.monotonic()
                if left_s <= 0:
                    raise TransportBusyError(
                        f"CAN interface {self.name}: frames are not accepted; is there another node on"
                        " the bus, and is the bus terminated?"
                    ) from error
                if error.errno == errno.ENOBUFS:
                    time.sleep(min(_RETRY_S, left_s))
                else:
                    wait_for(sock.fileno(), select.POLLOUT, left_s)
            else:
                return

    def receive(self, timeout_s: float) -> CanFrame | None:
        """See CanTransport.receive()."""
        deadline_s = time.monotonic() + timeout_s
        sock = self._open_socket()
        while True:
            try:
                frame = CanFrame.from_record(sock.recv(RECORD_SIZE))
            except BlockingIOError:
                if not wait_for(sock.fileno(), select.POLLIN, deadline_s - time.monotonic()):
                    return None
            except OSError as error:
                raise self._closed(error) from error
            else:
                if frame is not None:
                    return frame

    def _closed(self, error: OSError) -> TransportClosedError:
        return TransportClosedError(str(self._cannot("continue to use it", error)))

    def _open_socket(self) -> socket.socket:
        if self._socket is None:
            raise TransportClosedError(f"CAN interface {self.name}: already closed by this program")
        return self._socket


def _configure(sock: socket.socket) -> None:
    sock.setblocking(False)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER // 2)  # the kernel doubles it
    # The kernel doubles this too, and may silently give less than requested.
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER // 2)
    with contextlib.suppress(PermissionError):
        sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_BUFFER // 2)
    # Of error frames only bus-off, for whoever reads the descriptor.
    sock.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, struct.pack("=I", _CAN_ERR_BUSOFF))
    # Only what a node can send: neither extended nor remote frames.
    filters = struct.pack("=II", 0, socket.CAN_EFF_FLAG | socket.CAN_RTR_FLAG)
    sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)


def _require_up(interface: str) -> None:
    """Raise OSError when INTERFACE is down, which bind() accepts."""
    flags_up = 0x1
    try:
        with open(f"/sys/class/net/{interface}/flags", encoding="ascii") as flags:  # noqa: PTH123
            up = int(flags.read(), 16) & flags_up
    except FileNotFoundError:
        return  # no sysfs here; sending the first frame fails
    if not up:
        raise OSError(errno.ENETDOWN, os.strerror(errno.ENETDOWN))

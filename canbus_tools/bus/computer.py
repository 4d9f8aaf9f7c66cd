"""The computer on which tools run: its time, CAN buses and serial lines.

Simulations derive from ``Computer``, with virtual time and simulated wires.
"""

import asyncio
import time
from collections.abc import Callable, Coroutine
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

from canbus_tools.bus.frame_queue import FRAMES_MAX, FrameQueue
from canbus_tools.bus.open_bus import BusOptions, open_bus
from canbus_tools.protocol.frame import Frame
from nodes.link import LinkIO
from nodes.link.interfaces import OnFrame
from nodes.transport import ByteTransport, CanFrame, CanTransport, open_uart
from nodes.transport.python_can_bridge import PythonCanBridge
from nodes.transport.socketcan import SocketCanTransport
from nodes.transport.virtual import VirtualTransport

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Port:
    """An open CAN interface or serial line, for the project's own links."""

    name: str
    """Name in messages."""
    start_io: Callable[..., LinkIO]
    """Start its I/O in the running event loop; takes on_frame and on_closed as ``LinkIO`` does."""
    close: Callable[[], None]
    """Release the device, after the I/O was closed; a backend of python-can may take seconds."""


class Listener(Protocol):
    """Receives all frames of a bus, with the Unix times of their arrival."""

    @property
    def dropped(self) -> int:
        """Number of frames dropped for lack of room."""

    def take(self, timeout_s: float = 0.0) -> list[Frame]:
        """Return all waiting frames; waits for the first one for at most TIMEOUT_S.

        Raises CanductorError when the bus has failed and all its frames were returned.
        """

    def rest(self, quiet_s: float, limit_s: float) -> list[Frame]:
        """Stop listening when no frame comes for QUIET_S, or after LIMIT_S; return all waiting frames.

        Raises CanductorError as ``take`` does.
        """

    def only(self, can_id: int) -> None:
        """Receive only frames with this 11-bit id and error reports from now on."""


class FrameLine(Protocol):
    """A bus for single frames, without links."""

    def send(self, frame: CanFrame) -> None:
        """Send FRAME; raises CanductorError."""

    def receive(self, timeout_s: float) -> CanFrame | None:
        """Return the next data frame with an 11-bit id, or None after the timeout; raises CanductorError."""

    def close(self) -> None:
        """Release the bus."""


class Computer:
    """Time, buses and serial lines of this computer; methods that open a device raise CanductorError."""

    def monotonic_ns(self) -> int:
        """Return the time of links and event loops (HostTime, CLOCK_MONOTONIC)."""
        return time.monotonic_ns()

    def unix_s(self) -> float:
        """Return the Unix time, with which frames are stamped."""
        return time.time()

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)

    def run(self, main: Coroutine[Any, Any, T]) -> T:
        """Run MAIN in an event loop of its own."""
        return asyncio.run(main)

    def open_can(self, options: BusOptions) -> Port:
        """Open a bus for links: natively if possible, else by python-can."""
        return _port(_open_transport(options))

    def open_uart(self, path: str | Path, baud: int) -> Port:
        """Open a device file for a link, for this program alone."""
        return _port(open_uart(path, baud))

    def open_frames(self, options: BusOptions) -> FrameLine:
        """Open a bus for single frames, as ``open_can`` does."""
        return _open_transport(options)

    def listen(self, options: BusOptions, limit: int = FRAMES_MAX) -> AbstractContextManager[Listener]:
        """Listen on a bus, by python-can in a thread; beyond LIMIT waiting frames the oldest are dropped."""
        return FrameQueue(open_bus(options), options, limit=limit)


def now_s(computer: Computer) -> float:
    """Return COMPUTER's monotonic time in s."""
    return computer.monotonic_ns() * 1e-9


def _open_transport(options: BusOptions) -> CanTransport:
    if options.interface == "socketcan":
        return SocketCanTransport(options.channel, bitrate=options.bitrate)
    if options.interface == "canductor":
        return VirtualTransport(options.channel, bitrate=options.bitrate)
    return PythonCanBridge(open_bus(options), options.name, bitrate=options.bitrate)


def _port(transport: CanTransport | ByteTransport) -> Port:
    def start(*, on_frame: OnFrame | None = None, on_closed: Callable[[str], None] | None = None) -> LinkIO:
        return LinkIO(transport, asyncio.get_running_loop(), on_frame=on_frame, on_closed=on_closed)

    return Port(transport.name, start, transport.close)

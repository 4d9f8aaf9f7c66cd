"""What the tools need of the computer they run on: its time, its CAN buses and its serial lines.

`ThisComputer` is the real one; a simulation takes its place with virtual time and simulated wires.
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


class StartIO(Protocol):
    """Starts the links of an open port, in the running event loop; parameters as of ``LinkIO``."""

    def __call__(  # noqa: D102
        self, *, on_frame: OnFrame | None = None, on_closed: Callable[[str], None] | None = None
    ) -> LinkIO: ...


@dataclass(frozen=True, slots=True)
class Port:
    """An open CAN interface or serial line, for the project's own links."""

    name: str
    """For messages."""
    start_io: StartIO
    close: Callable[[], None]
    """Release the device, after the I/O was closed; a backend of python-can may take seconds."""


class Listener(Protocol):
    """Collects all frames of a bus, with the Unix times at which they came."""

    @property
    def dropped(self) -> int:
        """How many frames found no room."""

    def take(self, timeout_s: float = 0.0) -> list[Frame]:
        """Return all frames that wait, after at most TIMEOUT_S for the first one.

        Raises CanductorError when the bus has failed, once its last frames were returned.
        """

    def rest(self, quiet_s: float, limit_s: float) -> list[Frame]:
        """Stop listening once nothing comes for QUIET_S, or after LIMIT_S; return all frames that waited.

        Raises CanductorError as ``take`` does.
        """

    def only(self, can_id: int) -> None:
        """Receive nothing but frames with this 11-bit id, and error reports, from now on."""


class FrameLine(Protocol):
    """A bus for frames that belong to no node."""

    def send(self, frame: CanFrame) -> None:
        """Send FRAME; raises CanductorError."""

    def receive(self, timeout_s: float) -> CanFrame | None:
        """Return the next data frame with an 11-bit id, None after the timeout; raises CanductorError."""

    def close(self) -> None:
        """Release the bus."""


class Computer(Protocol):
    """Time, buses and serial lines. All that opens something raises CanductorError when it cannot."""

    def monotonic_ns(self) -> int:
        """Return the time that links and event loops count by (HostTime)."""

    def unix_s(self) -> float:
        """Return the Unix time, which frames are stamped with."""

    def sleep(self, seconds: float) -> None:
        """Wait."""

    def run(self, main: Coroutine[Any, Any, T]) -> T:
        """Run MAIN in an event loop of its own."""

    def open_can(self, options: BusOptions) -> Port:
        """Open a bus for links."""

    def open_uart(self, path: str | Path, baud: int) -> Port:
        """Open a serial line for a link."""

    def open_frames(self, options: BusOptions) -> FrameLine:
        """Open a bus for single frames."""

    def listen(self, options: BusOptions, limit: int = FRAMES_MAX) -> AbstractContextManager[Listener]:
        """Listen on a bus; when LIMIT frames wait, the oldest ones are dropped."""


def now_s(computer: Computer) -> float:
    """Return COMPUTER's monotonic time in s."""
    return computer.monotonic_ns() * 1e-9


class ThisComputer:
    """The real computer: its clocks, asyncio, SocketCAN, the virtual bus, python-can and device files."""

    def monotonic_ns(self) -> int:
        """Return CLOCK_MONOTONIC."""
        return time.monotonic_ns()

    def unix_s(self) -> float:
        """Return the Unix time."""
        return time.time()

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)

    def run(self, main: Coroutine[Any, Any, T]) -> T:
        """Run MAIN by asyncio."""
        return asyncio.run(main)

    def open_can(self, options: BusOptions) -> Port:
        """Open a bus natively where that is possible, else by python-can."""
        return _port(_open_transport(options))

    def open_uart(self, path: str | Path, baud: int) -> Port:
        """Open a device file for this program alone."""
        return _port(open_uart(path, baud))

    def open_frames(self, options: BusOptions) -> FrameLine:
        """Open a bus as ``open_can`` does."""
        return _open_transport(options)

    def listen(self, options: BusOptions, limit: int = FRAMES_MAX) -> FrameQueue:
        """Listen by python-can, in a thread."""
        return FrameQueue(open_bus(options), options, limit=limit)


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

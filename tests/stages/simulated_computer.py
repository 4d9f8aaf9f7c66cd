"""A computer in virtual time, for the CAN tools: their buses and serial lines are a simulated world's."""

import math
from collections import deque
from collections.abc import Callable, Coroutine
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self, TypeVar

from canbus_tools.bus.computer import Computer, Port
from canbus_tools.bus.frame_queue import FRAMES_MAX
from canbus_tools.bus.open_bus import BusOptions
from canbus_tools.protocol.frame import Frame, FrameKind
from nodes.link import BusSettings, LinkIO
from nodes.link.interfaces import OnFrame
from nodes.link.types import Frame as LinkFrame
from nodes.support.errors import CanductorError
from nodes.transport import CanFrame
from nodes.virtual.world import CanPort, CanWire, ControllerSettings, Uart, UartPort, World, run

T = TypeVar("T")
UNIX_AHEAD_S: Final = 1_700_000_000.0
"""Unix time less monotonic time."""
SEND_S: Final = 1.0
"""How long single frames may wait for room on the bus."""
_STEP_S: Final = 0.001
_ID_MAX: Final = 0x7FF
_ERROR_FLAG: Final = 0x2000_0000


class SimulatedComputer(Computer):
    """A computer attached to WIRES and UARTS of WORLD; its adapters lose LOSS of what they receive.

    Adapters come from a pool: what is open at the same time has an adapter each.
    """

    def __init__(
        self,
        world: World,
        wires: dict[str, CanWire],
        uarts: dict[str, Uart] | None = None,
        *,
        loss: float = 0.0,
    ) -> None:
        self.world = world
        self._wires = wires
        self._loss = loss
        self._uarts = {path: world.add_uart_port(uart) for path, uart in (uarts or {}).items()}
        self._free: dict[str, list[CanPort]] = {name: [] for name in wires}
        self._used: list[CanPort] = []

    # ------------------------------------------------------------------------------------------------- time

    def monotonic_ns(self) -> int:
        """Return the world's time."""
        return self.world.now_ns

    def unix_s(self) -> float:
        """Return the world's time, counted as Unix time."""
        return UNIX_AHEAD_S + self.world.now_ns * 1e-9

    def sleep(self, seconds: float) -> None:
        """Let the world go on for SECONDS."""
        self.world.run_for(seconds)

    def wait(self, seconds: float, until: Callable[[], object]) -> None:
        """Let the world go on until UNTIL is true, for SECONDS at most."""
        end_ns = self.world.now_ns + math.ceil(seconds * 1e9)  # time passes however short the wait
        while not until() and self.world.run_until(end_ns):
            for handler in self.world.noticed():
                handler()

    def run(self, main: Coroutine[Any, Any, T]) -> T:
        """Run MAIN in the world's time; whatever it leaves running is an error."""
        return run(self.world, main)

    # ------------------------------------------------------------------------------------------------ buses

    def open_can(self, options: BusOptions) -> Port:
        """Open an adapter for links."""
        port = self._take(options)

        def start(
            *, on_frame: OnFrame | None = None, on_closed: Callable[[str], None] | None = None
        ) -> LinkIO:
            settings = BusSettings(bitrate=options.bitrate or 0)
            return LinkIO.driven_by(port.open(settings), on_frame=on_frame, on_closed=on_closed)

        return Port(options.name, start, lambda: self._release(port))

    def open_uart(self, path: str | Path, baud: int) -> Port:
        """Open a serial line; its rate is the world's."""
        del baud
        port: UartPort | None = self._uarts.get(str(path))
        if port is None:
            raise CanductorError(f"{path}: cannot open: there is no such device")
        opened = port

        def start(
            *, on_frame: OnFrame | None = None, on_closed: Callable[[str], None] | None = None
        ) -> LinkIO:
            return LinkIO.driven_by(opened.open(BusSettings()), on_frame=on_frame, on_closed=on_closed)

        return Port(str(path), start, lambda: None)

    def open_frames(self, options: BusOptions) -> "WireUser":
        """Open an adapter for single frames."""
        return WireUser(self, options)

    def listen(self, options: BusOptions, limit: int = FRAMES_MAX) -> "WireListener":
        """Listen on a wire; at another bit rate than its own there is nothing to hear."""
        return WireListener(self, options, limit)

    def unplug(self, cause: int = 0) -> None:
        """Pull out every adapter that is open; CAUSE: the errno that programs get, 0: end of file."""
        for port in self._used:
            port.fail(cause)

    def open_io(self, options: BusOptions, on_frame: OnFrame, on_closed: Callable[[str], None]) -> Port:
        """Open an adapter and start its I/O; closing the port ends both."""
        port = self.open_can(options)
        io = port.start_io(on_frame=on_frame, on_closed=on_closed)

        def close() -> None:
            io.close()
            port.close()  # once more does nothing

        return Port(port.name, lambda **_: io, close)

    def _take(self, options: BusOptions) -> CanPort:
        wire = self._wires.get(options.channel)
        if wire is None:
            raise CanductorError(f"CAN bus {options.name}: no virtual CAN bus answers there")
        free = self._free[options.channel]
        if not free:
            settings = ControllerSettings(loss=self._loss, queue=1000)
            free.append(self.world.add_can_port(wire, controller=settings))
        port = free.pop()
        # At another bit rate than the wire's, an adapter is as good as alone.
        port.controller.cut(0 if options.bitrate in (None, wire.bitrate) else 1)
        self._used.append(port)
        return port

    def _release(self, port: CanPort) -> None:
        if port in self._used:
            self._used.remove(port)
            self._free[port.name].append(port)


class WireListener:
    """What ``Computer.listen`` returns, on a simulated wire."""

    def __init__(self, computer: SimulatedComputer, options: BusOptions, limit: int) -> None:
        self.dropped = 0
        self._computer = computer
        self._options = options
        self._frames: deque[Frame] = deque()
        self._limit = limit
        self._only: int | None = None
        self._cause = ""
        self._port = computer.open_io(options, self._came, self._ended)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._port.close()

    def take(self, timeout_s: float = 0.0) -> list[Frame]:
        """Return all frames that wait, after at most TIMEOUT_S for the first one."""
        self._computer.wait(timeout_s, lambda: self._frames or self._cause)
        frames = list(self._frames)
        self._frames.clear()
        if not frames and self._cause:
            raise CanductorError(f"CAN bus {self._options.name}: {self._cause}")
        return frames

    def rest(self, quiet_s: float, limit_s: float) -> list[Frame]:
        """Stop listening once nothing comes for QUIET_S, or after LIMIT_S; return all frames that waited."""
        end_ns = self._computer.monotonic_ns() + round(limit_s * 1e9)
        frames = self.take()
        while self._computer.monotonic_ns() < end_ns and (new := self.take(quiet_s)):
            frames += new
        self._port.close()
        return frames

    def only(self, can_id: int) -> None:
        """Receive nothing but frames with this id, and error reports, from now on."""
        self._only = can_id

    def _came(self, frame: LinkFrame) -> None:
        is_error = bool(frame.can_id & _ERROR_FLAG)
        if self._only not in (None, frame.can_id) and not is_error:
            return
        kind = FrameKind.ERROR if is_error else FrameKind.DATA
        time_s = UNIX_AHEAD_S + frame.received_ns * 1e-9
        can_id = frame.can_id & ~_ERROR_FLAG
        self.put(Frame(time_s, can_id, frame.data, kind, self._options.short_name))

    def put(self, frame: Frame) -> None:
        """Take FRAME as if it had been received."""
        if len(self._frames) >= self._limit:
            self._frames.popleft()
            self.dropped += 1
        self._frames.append(frame)

    def _ended(self, sentence: str) -> None:
        self._cause = sentence


class WireUser:
    """Somebody on a simulated bus: sends frames, and keeps those that come in ``frames``."""

    def __init__(
        self,
        computer: SimulatedComputer,
        options: BusOptions,
        answer: Callable[[CanFrame], CanFrame | None] | None = None,
    ) -> None:
        """Attach to the bus; ANSWER returns what to send when a frame came, if anything."""
        self.frames: list[CanFrame] = []
        """Everything that was received and not taken by ``receive``."""
        self._computer = computer
        self._answer = answer
        self._port = computer.open_io(options, self._came, lambda _: None)
        self._io = self._port.start_io()
        self._sent = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def send(self, frame: CanFrame) -> None:
        """Send FRAME as soon as the world goes on."""
        self._io.send_frame(frame.id, frame.data)
        self._sent += 1

    def receive(self, timeout_s: float) -> CanFrame | None:
        """Return the next data frame, None after the timeout."""
        self._computer.wait(timeout_s, lambda: self.frames)
        return self.frames.pop(0) if self.frames else None

    def close(self) -> None:
        """Leave the bus, once everything was handed to the adapter."""
        end_ns = self._computer.monotonic_ns() + round(SEND_S * 1e9)
        while self._io.stats().frames_sent < self._sent and self._computer.monotonic_ns() < end_ns:
            self._computer.sleep(_STEP_S)
        self._port.close()

    def sent_to(self, nodeid: int) -> list[bytes]:
        """Return the data of all frames to node NODEID."""
        return [frame.data for frame in self.frames if frame.id == nodeid * 2 + 0x100]

    def _came(self, came: LinkFrame) -> None:
        if came.can_id > _ID_MAX:
            return
        frame = CanFrame(came.can_id, came.data)
        self.frames.append(frame)
        answer = None if self._answer is None else self._answer(frame)
        if answer is not None:
            self.send(answer)

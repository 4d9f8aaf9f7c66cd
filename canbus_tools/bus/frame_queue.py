"""Receives the frames of a bus in a thread of its own, so that none is missed."""

import contextlib
import socket
import threading
import time
from collections import deque
from typing import Final, Self

import can

from canbus_tools.bus.open_bus import BusOptions
from canbus_tools.protocol.frame import Frame
from nodes.support.errors import CanductorError

FRAMES_MAX: Final = 100_000
"""Waiting frames: twelve seconds of a fully loaded bus at 1 Mbit/s."""
RECEIVE_BUFFER_BYTES: Final = 4 << 20
"""Requested from the kernel, which may grant less."""
_POLL_S: Final = 0.1
"""Interval at which the thread checks whether to end, as backends cannot be woken."""


class FrameQueue:
    """A Listener on BUS, which was opened with OPTIONS and which it closes. A context manager.

    When LIMIT frames wait, the oldest ones are dropped and counted in ``dropped``.
    """

    def __init__(self, bus: can.BusABC, options: BusOptions, *, limit: int = FRAMES_MAX) -> None:
        self.dropped = 0
        self._bus = bus
        self._options = options
        self._limit = limit
        self._waiting: deque[Frame] = deque()
        self._changed = threading.Condition()
        self._ending = False
        self._cause: CanductorError | None = None
        self._thread = threading.Thread(target=self._run, name=f"{options.name} receiver", daemon=True)
        _ask_for_room(bus)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending = True
        self._thread.join()
        self._bus.shutdown()

    def take(self, timeout_s: float = 0.0) -> list[Frame]:
        """Do as ``Listener.take``."""
        with self._changed:
            if not self._waiting and self._cause is None and timeout_s > 0:
                self._changed.wait(timeout_s)
            frames = list(self._waiting)
            self._waiting.clear()
            if not frames and self._cause is not None:
                raise self._cause.with_traceback(None)
        return frames

    def rest(self, quiet_s: float, limit_s: float) -> list[Frame]:
        """Do as ``Listener.rest``."""
        self._ending = True
        self._thread.join()
        end_s = time.monotonic() + limit_s
        while self._cause is None and time.monotonic() < end_s and self._receive(quiet_s):
            pass
        return self.take()

    def only(self, can_id: int) -> None:
        """Do as ``Listener.only``."""
        self._bus.set_filters([can.typechecking.CanFilter(can_id=can_id, can_mask=0x7FF, extended=False)])

    def _run(self) -> None:
        while not self._ending and self._cause is None:
            self._receive(_POLL_S)

    def _receive(self, timeout_s: float) -> bool:
        """Receive a frame; return whether there was one."""
        try:
            message = self._bus.recv(timeout_s)
        # Whatever a backend raises ends the reception and is reported.
        except Exception as error:  # noqa: BLE001
            said = " ".join(str(error).split()) or type(error).__name__
            with self._changed:
                self._cause = CanductorError(
                    f"CAN bus {self._options.name}: receiving failed: {said}; check the bus with "
                    f"'canductor can doctor {self._options.arguments}'"
                )
                self._changed.notify()
            return False
        if message is None:
            return False
        self._put(Frame.from_message(message)._replace(channel=self._options.short_name))
        return True

    def _put(self, frame: Frame) -> None:
        with self._changed:
            if len(self._waiting) >= self._limit:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(frame)
            self._changed.notify()


def _ask_for_room(bus: can.BusABC) -> None:
    """Enlarge the kernel's buffer of a socket; other backends have buffers of their own."""
    found = getattr(bus, "socket", None)
    if isinstance(found, socket.socket):
        with contextlib.suppress(OSError):
            found.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)

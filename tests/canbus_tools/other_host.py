"""Another program on the bus, and a witness of everything on it."""

import threading
import time
from contextlib import closing
from typing import Self

from nodes.transport import CanFrame
from tests.canbus_tools.stage import PATIENCE_S, Place

_POLL_S = 0.02


class OtherHost:
    """Sends a frame to a node again and again, as a host that prints with it does."""

    def __init__(self, place: Place, nodeid: int, data: bytes = b"\x7e") -> None:
        self._frame = CanFrame(nodeid * 2 + 0x100, data)
        self._transport = place.open()
        self._ending = threading.Event()
        self._began = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        with closing(self._transport):
            due_s = 0.0
            while not self._ending.is_set():
                if time.monotonic() >= due_s:
                    due_s = time.monotonic() + _POLL_S
                    self._transport.send(self._frame)
                    self._began.set()
                # What comes has to be read: the virtual bus waits for who does not.
                self._transport.receive(_POLL_S)

    def __enter__(self) -> Self:
        self._thread.start()
        assert self._began.wait(PATIENCE_S)
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join()


class Witness:
    """Keeps every frame of the bus."""

    def __init__(self, place: Place) -> None:
        self.frames: list[CanFrame] = []
        self._transport = place.open()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        with closing(self._transport):
            while True:
                frame = self._transport.receive(_POLL_S)
                if frame is not None:
                    self.frames.append(frame)
                elif self._ending.is_set():
                    return

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join()

    def sent_to(self, nodeid: int) -> list[bytes]:
        return [frame.data for frame in self.frames if frame.id == nodeid * 2 + 0x100]

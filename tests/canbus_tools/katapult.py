"""A board in its bootloader, as far as it shows on a CAN bus: it waits for an id with its own command."""

import threading
from types import TracebackType
from typing import Self

from nodes.assign import (
    ADMIN_ID,
    ADMIN_RESPONSE_ID,
    NEED_NODEID,
    QUERY_UNASSIGNED,
    SET_NODEID_BOOTLOADER,
    Uuid,
)
from nodes.transport import CanFrame, CanTransport

_POLL_S = 0.05


class Katapult:
    """Answers on TRANSPORT, which stays the caller's, by a thread of its own, as Katapult answers.

    Only what the protocol says of it: QUERY_UNASSIGNED, and SET_NODEID with the bootloader's own command;
    the application's command does not reach it. Its flashing protocol is not played.
    """

    def __init__(self, transport: CanTransport, uuid: Uuid) -> None:
        self.uuid = uuid
        self.nodeid = 0
        self.told_as_application = threading.Event()
        """Somebody took it for an application."""
        self._transport = transport
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"Katapult {uuid}", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ending.is_set():
            frame = self._transport.receive(_POLL_S)
            if frame is not None and frame.id == ADMIN_ID:
                self._answer(frame.data)

    def _answer(self, data: bytes) -> None:
        if data[:1] == bytes([QUERY_UNASSIGNED]) and not self.nodeid:
            answer = bytes([NEED_NODEID, *self.uuid.raw, SET_NODEID_BOOTLOADER])
            self._transport.send(CanFrame(ADMIN_RESPONSE_ID, answer))
        elif len(data) == 8 and data[1:7] == self.uuid.raw:
            if data[0] == SET_NODEID_BOOTLOADER:
                self.nodeid = data[7]
            else:
                self.told_as_application.set()

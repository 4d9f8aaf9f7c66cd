"""The virtual CAN bus as a backend of python-can: ``can.Bus(interface="canductor", channel=PATH)``.

Registered under the entry point group ``can.interface``, so that every tool based on python-can can use it.
"""

import time
from typing import Any

import can
from can.typechecking import CanFilters

from nodes.support.errors import CanductorError
from nodes.transport.base import TransportBusyError, TransportClosedError
from nodes.transport.frame import RECORD_SIZE, CanFrame
from nodes.transport.python_can_bridge import is_plain, to_message
from nodes.transport.virtual import VirtualTransport

_LONG_S = 3600.0
"""Length of one wait of a recv() without timeout, which is repeated."""


class CanductorBus(can.BusABC):
    """A client of the virtual bus whose Unix socket is CHANNEL. CAN 2.0A data frames only."""

    def __init__(self, channel: str, can_filters: CanFilters | None = None, **kwargs: Any) -> None:
        """Connect; raises can.CanInitializationError when there is no bus."""
        # can.Bus() passes the options of its configuration files; only the channel has a meaning here.
        try:
            self._transport = VirtualTransport(channel, read_size=RECORD_SIZE)
        except CanductorError as error:
            raise can.CanInitializationError(str(error)) from error
        self.channel_info = f"canductor's virtual bus {channel}"
        self._can_protocol = can.CanProtocol.CAN_20
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send MSG, waiting at most TIMEOUT seconds (None: 1) for room; raises can.CanOperationError."""
        if not is_plain(msg):
            raise can.CanOperationError(
                f"{self.channel_info} carries only data frames with 11-bit ids, not extended, remote or"
                " FD frames"
            )
        try:
            frame = CanFrame(msg.arbitration_id, bytes(msg.data))
            self._transport.send(frame, 1.0 if timeout is None else timeout)
        except TransportBusyError as error:
            raise can.CanTimeoutError(str(error)) from error
        except (TransportClosedError, ValueError) as error:
            raise can.CanOperationError(str(error)) from error

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            frame = self._transport.receive(_LONG_S if timeout is None else timeout)
        except TransportClosedError as error:
            raise can.CanOperationError(str(error)) from error
        if frame is None:
            return None, False
        message = to_message(frame)
        message.timestamp = time.time()
        message.channel = self.channel_info
        return message, False

    def fileno(self) -> int:
        """Return the file descriptor that becomes readable with new frames."""
        return self._transport.fileno()

    def shutdown(self) -> None:
        """Disconnect from the bus; further calls do nothing."""
        super().shutdown()
        self._transport.close()

"""A frame, live or from a recording."""

from enum import IntEnum
from typing import NamedTuple

import can


class FrameKind(IntEnum):
    """Kind of a frame."""

    DATA = 0
    """CAN 2.0A data frame, the only kind that nodes of this protocol use."""
    EXTENDED = 1
    REMOTE = 2
    ERROR = 3
    """The adapter's report of an error; ``can_id`` and ``data`` are those of linux/can/error.h."""
    FD = 4


class Frame(NamedTuple):
    """One frame; a tuple, as thousands come per second."""

    time_s: float
    """Unix time, or time of the recording."""
    can_id: int
    data: bytes
    kind: FrameKind = FrameKind.DATA
    channel: str = ""
    """Name of the bus, in a recording of several."""

    @classmethod
    def from_message(cls, message: can.Message) -> "Frame":
        """Convert a message of python-can."""
        if message.is_error_frame:
            kind = FrameKind.ERROR
        elif message.is_fd:
            kind = FrameKind.FD
        elif message.is_remote_frame:
            kind = FrameKind.REMOTE
        else:
            kind = FrameKind.EXTENDED if message.is_extended_id else FrameKind.DATA
        channel = "" if message.channel is None else str(message.channel)
        return cls(message.timestamp, message.arbitration_id, bytes(message.data), kind, channel)

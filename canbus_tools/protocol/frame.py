"""A frame as the tools see it, live or from a recording."""

from enum import IntEnum
from typing import NamedTuple

import can


class FrameKind(IntEnum):
    """What a frame is, besides its id."""

    DATA = 0
    """CAN 2.0A data frame: the only kind that nodes of this protocol use."""
    EXTENDED = 1
    REMOTE = 2
    ERROR = 3
    """The adapter's report of an error; ``can_id`` and ``data`` are those of linux/can/error.h."""
    FD = 4


class Frame(NamedTuple):
    """One frame; a tuple, because there are thousands in a second."""

    time_s: float
    """Unix time, or whatever the recording counts from."""
    can_id: int
    data: bytes
    kind: FrameKind = FrameKind.DATA
    channel: str = ""
    """Which bus, in a recording of several."""

    @classmethod
    def from_message(cls, message: can.Message) -> "Frame":
        """Take over what python-can received or read."""
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

    def to_message(self) -> can.Message:
        """Return it as python-can has it."""
        return can.Message(
            timestamp=self.time_s,
            arbitration_id=self.can_id,
            data=self.data,
            is_extended_id=self.kind is FrameKind.EXTENDED,
            is_remote_frame=self.kind is FrameKind.REMOTE,
            is_error_frame=self.kind is FrameKind.ERROR,
            is_fd=self.kind is FrameKind.FD,
            channel=self.channel or None,
        )

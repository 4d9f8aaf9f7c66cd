"""A CAN frame and its 16-byte record, the unit in which all CAN transports carry it."""

import struct
from dataclasses import dataclass
from typing import Self

RECORD_SIZE = 16
"""Bytes of a ``struct can_frame``."""
ID_MAX = 0x7FF
DATA_MAX = 8

_RECORD = struct.Struct("=IB3x8s")


@dataclass(frozen=True, slots=True)
class CanFrame:
    """A CAN 2.0A data frame: 11-bit id, at most 8 bytes; ValueError for anything else."""

    id: int
    data: bytes = b""

    def __post_init__(self) -> None:
        if not 0 <= self.id <= ID_MAX:
            raise ValueError(f"CAN id {self.id:#x} does not fit into 11 bits")
        if len(self.data) > DATA_MAX:
            raise ValueError(f"{len(self.data)} bytes do not fit into a CAN frame of {DATA_MAX}")

    def to_record(self) -> bytes:
        """Return the frame as ``struct can_frame`` of linux/can.h."""
        return _RECORD.pack(self.id, len(self.data), self.data)

    @classmethod
    def from_record(cls, record: bytes) -> Self | None:
        """Read a record; None unless it is a data frame with an 11-bit id (others have flags in the id)."""
        if len(record) != RECORD_SIZE:
            return None
        can_id, length, data = _RECORD.unpack(record)
        if can_id > ID_MAX or length > DATA_MAX:
            return None
        return cls(can_id, data[:length])

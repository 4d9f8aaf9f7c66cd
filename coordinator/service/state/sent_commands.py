"""Reading what was sent to nodes: the records of batches (nodes/link/core/batch.h)."""

from collections.abc import Sequence
from typing import Final

_REQ_CLOCK: Final = slice(8, 16)
_SIZE_AT: Final = 16
_HEADER: Final = 17


def read_batch(batch: bytes) -> Sequence[tuple[int, bytes]]:
    """Return of each command in BATCH the node's 64-bit clock at which it is due, and the encoded command."""
    found, at = [], 0
    while at + _HEADER <= len(batch):
        header = batch[at : at + _HEADER]
        begin, at = at + _HEADER, at + _HEADER + header[_SIZE_AT]
        found.append((int.from_bytes(header[_REQ_CLOCK], "little"), batch[begin:at]))
    return found

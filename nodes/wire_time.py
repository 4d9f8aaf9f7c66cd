"""How long messages are on the wire: known time, which need not blur the reading of a clock."""

from typing import Final

BLOCK_FRAMING: Final = 5
"""Bytes that a block has beside its content."""
FRAME_BYTES: Final = 8
FRAME_BITS: Final = 47 + 8 * FRAME_BYTES
"""A full CAN frame with interframe space, stuff bits not counted."""


def can_wire_ns(content_bytes: int, bitrate: int) -> int:
    """Return how long a block with so much content needs on a CAN bus of BITRATE bit/s, stuffing apart.

    The last frame counts as full: an answer shares it with the acknowledgement behind it, and is received no
    sooner than that frame ends.
    """
    frames = -(-(content_bytes + BLOCK_FRAMING) // FRAME_BYTES)
    return frames * FRAME_BITS * 1_000_000_000 // bitrate


def narrow(sent_ns: int, received_ns: int, out_ns: int, back_ns: int) -> tuple[int, int]:
    """Take the time on the wire off an exchange: what is left bounds when the node read its clock.

    An exchange that is shorter than that cannot have gone over such a wire: it is left as it is.
    """
    if sent_ns <= 0 or received_ns - sent_ns < out_ns + back_ns:
        return sent_ns, received_ns
    return sent_ns + out_ns, received_ns - back_ns

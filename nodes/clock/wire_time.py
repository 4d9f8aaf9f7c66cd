"""How long messages are on the wire: known time, which need not blur the reading of a clock."""

from typing import Final

BLOCK_FRAMING: Final = 5
"""Bytes that a block has beside its content."""
FRAME_BYTES: Final = 8
OVERHEAD_BITS: Final = 44
"""Of a frame, up to the end at which it counts as received; stuff bits, of which there may be none, apart."""
PAUSE_BITS: Final = 3
"""Between two frames."""
FRAME_BITS: Final = OVERHEAD_BITS + 8 * FRAME_BYTES


def can_wire_ns(content_bytes: int, bitrate: int, *, answer: bool) -> int:
    """Return how long a block with so much content needs on a CAN bus of BITRATE bit/s, for certain.

    The last frame of an ANSWER is full: it shares it with the acknowledgement behind it.
    """
    size = content_bytes + BLOCK_FRAMING
    frames = -(-size // FRAME_BYTES)
    last_bytes = FRAME_BYTES if answer else size - (frames - 1) * FRAME_BYTES
    bits = (frames - 1) * (FRAME_BITS + PAUSE_BITS) + OVERHEAD_BITS + 8 * last_bytes
    return bits * 1_000_000_000 // bitrate


def narrow(sent_ns: int, received_ns: int, out_ns: int, back_ns: int) -> tuple[int, int]:
    """Take the time on the wire off an exchange: what is left bounds when the node read its clock.

    An exchange that is shorter than that cannot have gone over such a wire: it is left as it is.
    """
    if sent_ns <= 0 or received_ns - sent_ns < out_ns + back_ns:
        return sent_ns, received_ns
    return sent_ns + out_ns, received_ns - back_ns

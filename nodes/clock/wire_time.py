"""Time of messages on the wire: a known delay, which need not widen the bounds on a clock."""

from typing import Final

BLOCK_FRAMING: Final = 5
"""Bytes of a block besides its content."""
FRAME_BYTES: Final = 8
OVERHEAD_BITS: Final = 44
"""Bits of a frame up to the point at which it counts as received; without stuff bits."""
PAUSE_BITS: Final = 3
"""Bits between two frames."""
FRAME_BITS: Final = OVERHEAD_BITS + 8 * FRAME_BYTES


def can_wire_ns(content_bytes: int, bitrate: int, *, answer: bool) -> int:
    """Return the least time that a block with so much content takes on a CAN bus of BITRATE bit/s.

    The last frame of an ANSWER counts as full: the acknowledgement behind it shares the frame.
    """
    size = content_bytes + BLOCK_FRAMING
    frames = -(-size // FRAME_BYTES)
    last_bytes = FRAME_BYTES if answer else size - (frames - 1) * FRAME_BYTES
    bits = (frames - 1) * (FRAME_BITS + PAUSE_BITS) + OVERHEAD_BITS + 8 * last_bytes
    return bits * 1_000_000_000 // bitrate


def narrow(sent_ns: int, received_ns: int, out_ns: int, back_ns: int) -> tuple[int, int]:
    """Subtract the time on the wire from an exchange: the rest bounds when the node read its clock.

    An exchange that is shorter than that cannot have used such a wire: it is left unchanged.
    """
    if sent_ns <= 0 or received_ns - sent_ns < out_ns + back_ns:
        return sent_ns, received_ns
    return sent_ns + out_ns, received_ns - back_ns

"""Cost and least duration of a transmission of MT, for comparison with measured times."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from nodes.mt.mt import CLOSING, LIT
from nodes.support._can_bits import lib
from nodes.support.can_protocol import MT_CAN_ID

AROUND: Final = 10
"""Number of words at the beginning and end of a transmission, which are neither values nor LIT."""
LOAD_MAX: Final = 0.999


def literals(words: Sequence[int]) -> int:
    """Return how many LIT a sender inserted between the values of a transmission's WORDS."""
    values = words[AROUND - len(CLOSING) : -len(CLOSING)]
    return sum(word == LIT for word in values)


def frame_bits(frames: Sequence[bytes], can_id: int = MT_CAN_ID) -> list[int]:
    """Return the bits that each of FRAMES takes on a bus: true lengths, interframe space included."""
    return [int(lib.can_frame_bits(can_id, len(frame), frame)) for frame in frames]


@dataclass(frozen=True, slots=True)
class RegisterCost:
    """Through a polled register: one word every DELAY_S and no faster, since the drive would miss words."""

    pairs: int
    words: int
    literals: int
    delay_s: float

    @property
    def values_s(self) -> float:
        """The bound of the protocol: 2 l words of T."""
        return 2 * self.pairs * self.delay_s

    @property
    def bound_s(self) -> float:
        """Duration of all words; the last one is held as long as the others."""
        return self.words * self.delay_s

    def text(self) -> str:
        """Return it for a reader."""
        return (
            f"2·l·T = 2·{self.pairs}·{self.delay_s * 1e3:g} ms = {self.values_s:.3f} s; with {AROUND} words "
            f"that begin and end it and {self.literals} LIT {self.bound_s:.3f} s"
        )


@dataclass(frozen=True, slots=True)
class SerialCost:
    """As bytes of a serial line, 10 bits each."""

    size: int
    baud: int

    @property
    def bound_s(self) -> float:
        """Without a pause."""
        return self.size * 10 / self.baud

    def text(self) -> str:
        """Return it for a reader."""
        return f"{self.size} bytes at {self.baud} baud: {self.bound_s:.3f} s"


@dataclass(frozen=True, slots=True)
class CanCost:
    """One broadcast on a bus of BITRATE, of which the sender takes SHARE and others took LOAD just before."""

    frames: int
    bits: int
    bitrate: int
    share: float
    load: float = 0.0
    """0: nothing, or not known."""

    @property
    def alone_s(self) -> float:
        """With the whole bus: the least possible duration."""
        return self.bits / self.bitrate

    @property
    def paced_s(self) -> float:
        """Duration within the share."""
        return self.alone_s / self.share

    @property
    def free_s(self) -> float:
        """Duration with the capacity that others leave: tables have the lowest priority."""
        return self.alone_s / (1 - min(self.load, LOAD_MAX))

    @property
    def bound_s(self) -> float:
        """Least duration of one broadcast, without queries before and after, and without repeats."""
        return max(self.paced_s, self.free_s)

    def text(self) -> str:
        """Return it for a reader."""
        text = (
            f"{self.bits} bits: {self.alone_s * 1e3:.1f} ms of {self.bitrate} bit/s, "
            f"{self.paced_s * 1e3:.1f} ms within a share of {self.share:.0%}"
        )
        if self.load:
            text += f", {self.free_s * 1e3:.1f} ms with all that others leave ({1 - self.load:.0%})"
        return text

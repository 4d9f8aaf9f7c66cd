"""What a transmission of MT costs, and how long it takes at least: what measured times are told against."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from nodes.mt.mt import CLOSING, LIT
from nodes.support._can_bits import lib
from nodes.support.can_protocol import MT_CAN_ID

AROUND: Final = 10
"""Words of a transmission that are neither values nor LIT: what begins and ends it."""
FRAME_BITS_MAX: Final = 135
"""Of a frame with two words, stuffing and the pause behind it included, whatever they are."""
LOAD_MAX: Final = 0.999


def literals(words: Sequence[int]) -> int:
    """Return how many LIT a sender put in between the values of a transmission's WORDS."""
    values = words[AROUND - len(CLOSING) : -len(CLOSING)]
    return sum(word == LIT for word in values)


def frame_bits(frames: Sequence[bytes], can_id: int = MT_CAN_ID) -> list[int]:
    """Return what each of FRAMES takes of a bus, in bits: true lengths, with the pause behind."""
    return [int(lib.can_frame_bits(can_id, len(frame), frame)) for frame in frames]


@dataclass(frozen=True, slots=True)
class RegisterCost:
    """By a polled register: one word every DELAY_S, and no faster, since the drive would miss one."""

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
        """Of all words; the last one stands as long as the others."""
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
        """With the whole bus: no sender is faster."""
        return self.bits / self.bitrate

    @property
    def paced_s(self) -> float:
        """Within the share."""
        return self.alone_s / self.share

    @property
    def free_s(self) -> float:
        """With all that others leave: tables have the lowest priority."""
        return self.alone_s / (1 - min(self.load, LOAD_MAX))

    @property
    def bound_s(self) -> float:
        """What one broadcast takes at least. Asking nodes before and after, and repeats, come on top."""
        return max(self.paced_s, self.free_s)

    def text(self) -> str:
        """Return it for a reader."""
        told = (
            f"{self.bits} bits: {self.alone_s * 1e3:.1f} ms of {self.bitrate} bit/s, "
            f"{self.paced_s * 1e3:.1f} ms within a share of {self.share:.0%}"
        )
        if self.load:
            told += f", {self.free_s * 1e3:.1f} ms with all that others leave ({1 - self.load:.0%})"
        return told

"""Fault rules of a virtual bus.

A rule selects frames by id, sender and time, and affects a share of them, or the n-th of each sender. Which
frames depends only on the seed and on the sender's own frames: the same program under test meets the same
faults again, however its threads and processes are scheduled (``hub_faults.h``).
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

from nodes.support.errors import CanductorError

ID_MAX: Final = 0x7FF
CLIENTS: Final = 64
RULES_MAX: Final = 32
TIME_S_MAX: Final = 1e8
"""Three years: far below the rollover of the bus's 64-bit nanoseconds."""


class BusFaultKind(IntEnum):
    """What happens to an affected frame; the numbers are those of ``enum hub_fault_kind``."""

    LOSE = 0
    """The receivers do not get it; the sender assumes that they did."""
    CORRUPT = 1
    """The receivers get it with one bit of its data changed."""
    DUPLICATE = 2
    """The receivers get it; the sender assumes that they did not, and repeats it."""
    ERROR = 3
    """An error frame destroys it: that takes bus time, and the sender tries again. After 32 consecutive
    failures the sender is bus-off until it has seen 128 times 11 bits."""
    DELAY = 4
    """It is sent later, and so are the frames that its sender queued after it."""
    BUS_OFF = 5
    """Its sender leaves the bus for a time: it receives nothing; all that it sends is lost."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BusFault:
    """One rule. Times count from the moment at which the rules are set."""

    kind: BusFaultKind
    share: float = 1.0
    """0..1 of the selected frames."""
    nth: int | None = None
    """Instead of a share: the n-th selected frame of each sender, counted from 1."""
    can_id: int = 0
    mask: int = 0
    """Selects frames whose id has the bits of ``can_id`` where ``mask`` has ones."""
    sender: int | None = None
    """Place of the client on the bus, 0..63 in the order of connecting; None: all clients."""
    receiver: int | None = None
    """The client affected by a loss or corruption; None: all clients."""
    from_s: float = 0.0
    until_s: float | None = None
    """Selects frames between these times; None: without end."""
    time_s: float = 0.0
    """Duration of a delay or bus-off."""
    jitter_s: float = 0.0
    """Uniformly distributed addition to a delay: at most this."""
    timed: bool = False
    """Only with BUS_OFF: selects no frames; at ``from_s`` the sender (or all clients) leaves the bus."""

    def __post_init__(self) -> None:
        """Check the ranges; raises CanductorError."""
        name = f"fault {self.kind.name.lower()}"
        _check(name, "share", self.share, 0, 1)
        _check(name, "frame", 1 if self.nth is None else self.nth, 1, 2**63)
        _check(name, "id", self.can_id, 0, ID_MAX)
        _check(name, "mask", self.mask, 0, ID_MAX)
        for what, place in (("sender", self.sender), ("receiver", self.receiver)):
            _check(name, what, place or 0, 0, CLIENTS - 1)
        _check(name, "begin", self.from_s, 0, TIME_S_MAX)
        if self.until_s is not None:
            _check(name, "end", self.until_s, self.from_s, TIME_S_MAX)
        _check(name, "time", self.time_s, 0, TIME_S_MAX)
        _check(name, "jitter", self.jitter_s, 0, TIME_S_MAX)
        if self.receiver is not None and self.kind not in (BusFaultKind.LOSE, BusFaultKind.CORRUPT):
            raise CanductorError(f"{name}: only a loss or corruption can have a receiver")
        if self.kind is BusFaultKind.BUS_OFF and self.time_s == 0:
            raise CanductorError(f"{name}: its time must be above 0 s")
        if self.timed and self.kind is not BusFaultKind.BUS_OFF:
            raise CanductorError(f"{name}: only bus-off can be timed")

    def to_c(self) -> dict[str, Any]:
        """Return the fields of ``struct hub_rule``."""
        until_s = TIME_S_MAX * 2 if self.until_s is None else self.until_s
        return {
            "kind": self.kind.value,
            "id": self.can_id,
            "mask": self.mask,
            "sender": -1 if self.sender is None else self.sender,
            "receiver": -1 if self.receiver is None else self.receiver,
            "share": self.share,
            "nth": self.nth or 0,
            "from_ns": round(self.from_s * 1e9),
            "until_ns": round(until_s * 1e9),
            "time_ns": round(self.time_s * 1e9),
            "jitter_ns": round(self.jitter_s * 1e9),
            "timed": self.timed,
        }


def _check(name: str, what: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise CanductorError(f"{name}: {what} {value:g} is not between {low:g} and {high:g}")

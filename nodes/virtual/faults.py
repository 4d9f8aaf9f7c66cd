"""What goes wrong on a virtual bus on purpose: rules as Python has them.

A rule picks frames by id, sender and time, and hits a share of them, or of each sender the n-th. What it hits
depends on the seed and on the sender's own frames only: the same program under test meets the same faults
again, however its threads and processes are scheduled (``hub_faults.h``).
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
    """What happens to a frame that is hit; the numbers are those of ``enum hub_fault_kind``."""

    LOSE = 0
    """The receivers do not get it, the sender believes they did."""
    CORRUPT = 1
    """The receivers get it with one bit of its data changed."""
    DUPLICATE = 2
    """The receivers get it; the sender believes they did not and repeats it."""
    ERROR = 3
    """It is destroyed by an error frame: that costs bus time, and the sender tries again. After 32 failures
    in a row the sender is bus-off until it has seen 128 times 11 bits."""
    DELAY = 4
    """It comes later, and what its sender has behind it waits too."""
    BUS_OFF = 5
    """Its sender leaves the bus for a time: it hears nothing; this frame and all it sends are gone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BusFault:
    """One rule. Times count from the moment the bus gets its rules."""

    kind: BusFaultKind
    share: float = 1.0
    """0..1 of the frames picked."""
    nth: int | None = None
    """Instead of a share: of each sender the n-th frame picked, counted from 1."""
    can_id: int = 0
    mask: int = 0
    """Picks frames whose id has the bits of ``can_id`` where ``mask`` has ones."""
    sender: int | None = None
    """Place of the client on the bus, 0..63 in the order of connecting; None: anyone."""
    receiver: int | None = None
    """Who is hit by a loss or corruption; None: everyone."""
    from_s: float = 0.0
    until_s: float | None = None
    """Picks frames from the one until the other; None: without end."""
    time_s: float = 0.0
    """How long a delay or bus-off lasts."""
    jitter_s: float = 0.0
    """A delay gets up to this more, evenly spread."""
    timed: bool = False
    """Only of BUS_OFF: picks no frames; at ``from_s`` the sender, or everybody, goes off."""

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
            raise CanductorError(f"{name}: only a loss or corruption can hit a single receiver")
        if self.kind is BusFaultKind.BUS_OFF and self.time_s == 0:
            raise CanductorError(f"{name}: needs to last for some time")
        if self.timed and self.kind is not BusFaultKind.BUS_OFF:
            raise CanductorError(f"{name}: only bus-off can happen without a frame")

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

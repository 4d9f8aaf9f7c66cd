"""The interface of an estimate of a node's clock, whatever its source."""

from typing import Protocol

from nodes.clock.clock import HostTime, Ticks


class EstimatedClock(Protocol):
    """A node's clock as far as the host knows it."""

    def ticks_at(self, at_ns: HostTime, /) -> Ticks:
        """Return the node's 64-bit ticks at a host time."""
        ...

    def ns_at(self, ticks: Ticks, /) -> HostTime:
        """Return the host time at which the node's clock stands at TICKS."""
        ...

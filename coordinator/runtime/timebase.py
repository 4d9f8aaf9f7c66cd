"""Print time, and its conversion to host time and to every node's ticks.

Print time is seconds of the primary node's clock at its nominal frequency. The primary's ticks follow from
it by a constant factor; those of a secondary node are steered: its map is made of straight pieces that join
without a jump, each aimed at where the two clock estimators say the node's clock will be a moment later.
"""

import math
from array import array
from collections.abc import Iterable
from dataclasses import dataclass

from nodes.clock.clock import ClockEstimator, HostTime, Ticks
from nodes.clock.estimated_clock import EstimatedClock
from nodes.clock.sync_pulse import PulseClock
from nodes.node.node import Node
from nodes.support.errors import CanductorError

STEER_HORIZON_S = 1.0
"""A difference to the estimate is worked off over this long: shorter follows faster, longer is smoother.

With sync pulses at 1 µs of interrupt jitter the estimate is good for 0.24 µs rms, and the map, made 1.8 s
ahead, for 0.34 µs: it follows well enough. A change-over from exchanges to pulses, some 10 µs apart, bends
the rate by no more than 10 ppm.
"""

SLEW_LIMIT = 500e-6
"""By how much of its rate a map may deviate to work off a difference: 0.5 µs per ms."""

JUMP_LIMIT_S = 0.005
"""A node whose clock is further off than this cannot be steered without late or early steps."""


class ClockJumpError(CanductorError):
    """A node's clock is not where it can be followed to."""


@dataclass(frozen=True, slots=True)
class ClockPiece:
    """One straight piece of a map, valid from its print time on."""

    print_time: float
    ticks: float
    ticks_per_s: float


class ClockMap:
    """From print time to one node's ticks: continuous, made of straight pieces."""

    def __init__(self, clock_freq: float, first: ClockPiece) -> None:
        self.clock_freq = clock_freq
        self.last = first
        """The piece in force."""
        self._ended = array("d")
        """The pieces before it, three numbers each: a proof of a long run keeps them all."""

    def bend(self, print_time: float, ticks_per_s: float) -> ClockPiece:
        """Go on from PRINT_TIME (not before the last piece) at another rate; return the new piece."""
        last = self.last
        assert print_time >= last.print_time
        ticks = last.ticks + (print_time - last.print_time) * last.ticks_per_s
        piece = ClockPiece(print_time, ticks, ticks_per_s)
        if print_time > last.print_time:
            self._ended.extend((last.print_time, last.ticks, last.ticks_per_s))
        self.last = piece
        return piece

    def forget(self) -> None:
        """Forget every piece but the one in force: a map that is only steered by stays small."""
        del self._ended[:]

    @property
    def pieces(self) -> list[ClockPiece]:
        """All pieces, those that have ended first."""
        ended = (ClockPiece(*self._ended[at : at + 3]) for at in range(0, len(self._ended), 3))
        return [*ended, self.last]


class JumpWatch:
    """Looks for jumps of the clocks of NODES during moves; steps sent before a jump are at wrong times."""

    def __init__(self, nodes: Iterable[Node]) -> None:
        self._nodes = {node.name: node for node in nodes}
        self._seen: dict[str, tuple[ClockEstimator, int]] = {}
        self._looked_s = math.inf

    def look(self, now_s: float, moves_until_s: float) -> None:
        """Look at NOW_S, with moves generated until MOVES_UNTIL_S (print times).

        Raises ClockJumpError when a clock has jumped since the last look and the machine moved at that time.
        What time it is after a jump says nothing about that: the primary node's clock may have jumped.
        """
        moved = self._looked_s < moves_until_s
        self._looked_s = now_s
        for name, node in self._nodes.items():
            clock = node.clock
            seen, self._seen[name] = self._seen.get(name), (clock, clock.jumps)
            if moved and seen is not None and seen[0] is clock and seen[1] != clock.jumps:
                raise ClockJumpError(
                    f"the clock of node {name} jumped by {clock.jump_s * 1e3:+.1f} ms during a move; its "
                    "oscillator or its link is failing, or the host's clock is: check the board's supply and "
                    "the wiring"
                )


class TimeBase:
    """Print time of a machine whose primary node has this clock."""

    def __init__(self, primary: EstimatedClock, clock_freq: float) -> None:
        self._primary = primary
        self._clock_freq = clock_freq

    def print_time_at(self, host_ns: HostTime) -> float:
        """Return the print time at a moment of host time, in s."""
        return self._primary.ticks_at(host_ns) / self._clock_freq

    def host_ns_at(self, print_time: float) -> HostTime:
        """Return the host time of a print time."""
        return self._primary.ns_at(Ticks(round(print_time * self._clock_freq)))

    def ticks_at(self, clock: EstimatedClock, print_time: float) -> Ticks:
        """Return a node's ticks at PRINT_TIME as CLOCK estimates them.

        A clock that pulses tie to the primary's needs no host time: the primary's estimate, which another
        thread may renew between two looks at it, has no part in it.
        """
        if clock is self._primary:
            return Ticks(round(print_time * self._clock_freq))
        if isinstance(clock, PulseClock) and clock.reference is self._primary:
            return clock.line.ticks_at(Ticks(round(print_time * self._clock_freq)))
        return clock.ticks_at(self.host_ns_at(print_time))

    def print_time_of(self, clock: EstimatedClock, ticks: Ticks) -> float:
        """Return the print time at which a node's clock, as CLOCK estimates it, shows TICKS."""
        return ticks / self._clock_freq if clock is self._primary else self.print_time_at(clock.ns_at(ticks))

    def primary_map(self, print_time: float) -> ClockMap:
        """Return the primary node's own map, which never bends."""
        ticks = print_time * self._clock_freq
        return ClockMap(self._clock_freq, ClockPiece(print_time, ticks, self._clock_freq))

    def secondary_map(self, clock: EstimatedClock, clock_freq: float, print_time: float) -> ClockMap:
        """Return a secondary node's map, beginning at PRINT_TIME where the estimators see its clock."""
        ticks = self.ticks_at(clock, print_time)
        ahead = self.ticks_at(clock, print_time + STEER_HORIZON_S)
        return ClockMap(clock_freq, ClockPiece(print_time, ticks, (ahead - ticks) / STEER_HORIZON_S))

    def steer(self, name: str, clock_map: ClockMap, clock: EstimatedClock, print_time: float) -> ClockPiece:
        """Bend a secondary node's map at PRINT_TIME towards the estimate; return the new piece.

        Raises ClockJumpError when the estimate is beyond what slewing can follow.
        """
        last = clock_map.last
        mapped = last.ticks + (print_time - last.print_time) * last.ticks_per_s
        here = self.ticks_at(clock, print_time)
        ahead = self.ticks_at(clock, print_time + STEER_HORIZON_S)
        off_s = (here - mapped) / clock_map.clock_freq
        if abs(off_s) > JUMP_LIMIT_S:
            raise ClockJumpError(
                f"the clock of node {name} is {off_s * 1e3:+.1f} ms from where its steps were timed; "
                "its oscillator or its link is failing: check the board's supply and the wiring",
            )
        rate = (ahead - here) / STEER_HORIZON_S
        slew = (here - mapped) / STEER_HORIZON_S
        limit = SLEW_LIMIT * rate
        return clock_map.bend(print_time, rate + min(max(slew, -limit), limit))

"""One node's clock relative to another's, from pairs of simultaneous readings. Sans-IO.

A sync pulse is one CAN frame: every node latches its clock when the frame has ended, which happens everywhere
on a bus within a bit time. The latency of the receive interrupts differs: usually by a fraction of a
microsecond, sometimes by much more, on either side. So the difference of the two clocks is fitted by a
parabola (crystals warm up at different rates), and readings are weighted less the further off and the older
they are. The arithmetic that goes over all pairs is in pulse_parabola.c.
"""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from nodes.clock._clock import ffi, lib
from nodes.clock.clock import Ticks

PAIRS_MAX: Final[int] = lib.PULSE_PAIRS_MAX
SETTLE_PAIRS: Final = 24
SETTLE_S: Final = 1.0
"""The rate is known to about 0.2 ppm after so many pairs over so long."""
BEND_S: Final = 6.0
"""Seconds ahead for which a curvature is extrapolated at most."""
RATE_PRIOR: Final = 1e-3
CURVATURE_PRIOR_PER_S: Final = 1e-7
"""Standard deviations for two crystals before anything is measured."""
JUMP_S: Final = 1e-3
"""No two crystals diverge by so much between two pulses: one of the nodes restarted."""
REACH_S: Final = 1.5
"""How far beyond the last pair the error bound holds: as far as steps are generated ahead."""
CONFIDENCE: Final = 3.0


@dataclass(frozen=True, slots=True)
class PulseLine:
    """A node's clock as a function of the reference node's; immutable, so that any thread may use it."""

    reference: Ticks
    ticks: Ticks
    """The two clocks at the last pulse, as they were latched."""
    reference_hz: int
    freq_hz: int
    offset_s: float
    """Deviation of the latched pair from the fit."""
    rate: float
    """By how much the node's clock is faster, relative to nominal: 1e-6 is 1 ppm."""
    curvature_per_s: float
    error_s: float
    """Bound of the error up to REACH_S ahead of the last pulse, interrupt latency included."""

    def ticks_at(self, reference: Ticks) -> Ticks:
        """Return the node's clock when the reference's shows REFERENCE."""
        t = (reference - self.reference) / self.reference_hz
        return Ticks(self.ticks + round((t + self._parting_s(t)) * self.freq_hz))

    def reference_at(self, ticks: Ticks) -> Ticks:
        """Return the reference's clock when the node's shows TICKS."""
        passed = (ticks - self.ticks) / self.freq_hz
        t = passed
        for _ in range(3):  # each iteration gains at least three digits: rates differ by less than RATE_PRIOR
            t = passed - self._parting_s(t)
        return Ticks(self.reference + round(t * self.reference_hz))

    def _parting_s(self, t: float) -> float:
        """Return by how much more than T the node's clock has moved T s after the last pulse."""
        bend_s = min(t, BEND_S)
        return self.offset_s + self.rate * t + self.curvature_per_s * bend_s * bend_s / 2


class PulseFit:
    """Fits the clock of a node (FREQ_HZ nominal) to the reference node's (REFERENCE_HZ nominal)."""

    def __init__(self, reference_hz: int, freq_hz: int) -> None:
        self._reference_hz = reference_hz
        self._freq_hz = freq_hz
        self._pairs: deque[tuple[Ticks, Ticks]] = deque(maxlen=PAIRS_MAX)
        self._parabola: Any = ffi.new("struct pulse_parabola *")
        self.line: PulseLine | None = None
        """The newest fit; None before the first pair."""
        self.line_before: PulseLine | None = None
        """The fit before a jump, until there are enough pairs after it."""
        self.restarts = 0
        """Number of restarts of the fit after a jump of either clock."""

    @property
    def settled(self) -> bool:
        """Whether there are enough pairs, over a sufficient time."""
        if len(self._pairs) < SETTLE_PAIRS:
            return False
        return (self._pairs[-1][0] - self._pairs[0][0]) / self._reference_hz >= SETTLE_S

    def add(self, reference: Ticks, ticks: Ticks) -> None:
        """Add a pair of clocks latched together; pairs come in order."""
        if self.line is not None and self._jumped(self.line, reference, ticks):
            if self.settled:
                self.line_before = self.line
            self._pairs.clear()
            self.restarts += 1
        self._pairs.append((reference, ticks))
        self.line = self._fit(self._off_the_last_line())
        if self.settled:
            self.line_before = None

    def fill(self, pairs: Iterable[tuple[Ticks, Ticks]]) -> None:
        """Start again with PAIRS, in order; pairs before a jump of either clock do not count."""
        self._pairs.clear()
        for pair in pairs:
            if self._pairs and self._parted(self._pairs[-1], pair):
                self._pairs.clear()
            self._pairs.append(pair)
        self.line = self._fit([0.0] * len(self._pairs)) if self._pairs else None

    def _parted(self, earlier: tuple[Ticks, Ticks], later: tuple[Ticks, Ticks]) -> bool:
        passed_s = (later[0] - earlier[0]) / self._reference_hz
        off_s = abs((later[1] - earlier[1]) / self._freq_hz - passed_s)
        return passed_s <= 0 or off_s > JUMP_S + RATE_PRIOR * passed_s

    def _jumped(self, line: PulseLine, reference: Ticks, ticks: Ticks) -> bool:
        passed_s = (reference - line.reference) / self._reference_hz
        off_s = abs(ticks - line.ticks_at(reference)) / self._freq_hz
        return passed_s <= 0 or off_s > JUMP_S + RATE_PRIOR * passed_s

    def _fit(self, off_s: Sequence[float]) -> PulseLine:
        """Fit the pairs, whose known deviations are OFF_S."""
        last_reference, last_ticks = self._pairs[-1]
        at_s = [(reference - last_reference) / self._reference_hz for reference, _ in self._pairs]
        own_s = [(ticks - last_ticks) / self._freq_hz for _, ticks in self._pairs]
        parabola = self._parabola
        parabola.count = len(at_s)
        parabola.at_s = at_s
        parabola.parted_s = [own - t for own, t in zip(own_s, at_s, strict=True)]
        parabola.off_s = off_s
        sd_s = lib.pulse_parabola_fit(parabola, RATE_PRIOR, CURVATURE_PRIOR_PER_S, REACH_S)
        offset_s, rate, curvature_per_s = parabola.fitted
        return PulseLine(
            last_reference,
            last_ticks,
            self._reference_hz,
            self._freq_hz,
            offset_s,
            rate,
            curvature_per_s,
            CONFIDENCE * sd_s + parabola.noise_s,
        )

    def _off_the_last_line(self) -> list[float]:
        """Return the deviation of pairs from the last fit, so that a late latch cannot bend the new one."""
        line, count = self.line, len(self._pairs)
        if line is None or count < SETTLE_PAIRS:
            return [0.0] * count
        reference, ticks = self._pairs[-1]
        newest_s = abs(ticks - line.ticks_at(reference)) / self._freq_hz
        return [*ffi.unpack(self._parabola.off_s, self._parabola.count), newest_s][-count:]

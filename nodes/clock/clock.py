"""Time between the host and a node: the types, and the estimate of a node's clock from its answers.

Sans-IO: samples come in with their times, an estimate and the time of the next sample go out. Host time
is CLOCK_MONOTONIC in integer nanoseconds; a node's ticks have 64 bits in the host and 32 on the wire.

Method: the clock in an answer requested at S and received at R was read after S plus the shortest delay out
and before R minus the shortest delay back: two bounds on the clock, most of them loose, some tight. The first
START_SAMPLES are fitted together (start.py), the later ones update a filter that follows temperature
(fit.py). A slow exchange only gives loose bounds, so no series of them can spoil the estimate. An answer
beyond both bounds is impossible and not used, unless several in a row agree: then the clock has jumped, or
the host has slept.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Final, NamedTuple, NewType

from nodes.clock.blend import Blend
from nodes.clock.fit import RATE_SD, Filter
from nodes.clock.start import START_SAMPLES, Start
from nodes.support.errors import CanductorError

HostTime = NewType("HostTime", int)
"""Nanoseconds of the host's CLOCK_MONOTONIC."""
Ticks = NewType("Ticks", int)
"""A node's clock in 64 bits."""

BURST_SAMPLES: Final = 16
BURST_INTERVAL_NS: Final = 25_000_000
SETTLE_SAMPLES: Final = 48
SETTLE_INTERVAL_NS: Final = 50_000_000
"""After the burst, up to SETTLE_SAMPLES: two seconds after the start the rate is known to some 10 ppm."""
SAMPLE_INTERVAL_NS: Final = 984_300_000
"""Not a divisor or multiple of a second: periodic work on a node must not meet every sample."""
REMEMBERED: Final = 160
"""Number of exchanges among which the fastest is sought."""
CONTRADICTIONS: Final = 4
"""After so many consecutive answers that contradict the estimate, but not each other, it starts again."""
BROKEN: Final = 8
"""After so many that contradict each other, too, the clock is unusable."""
JUMP_S: Final = 1e-3
"""From so far off on, a clock whose estimate begins again has jumped. A host whose own clock is slewed, by
500 ppm at most as usual, is less than that off by then."""
LATELY_NS: Final = 3_000_000_000
"""A jump that was found within this time explains what a node makes of commands that were made before."""
GAP_NS: Final = 600_000_000_000
"""Silence after which the filter starts again: the temperature may have changed arbitrarily."""
AHEAD_S: Final = 1.0
"""Time after a sample for which the error bound holds."""
UPTIME_MAX_S: Final = 3e8
"""Nearly ten years: ticks fit the integers that count them, and print time keeps a resolution of 0.1 µs."""
CONFIDENCE: Final = 4.0
"""Standard deviations in the published error bound."""
_HALF: Final = 1 << 31
_WHOLE: Final = 1 << 32


def ticks_since(later: int, earlier: int) -> int:
    """Return LATER - EARLIER for two 32-bit clocks less than 2^31 ticks apart: -2^31..2^31-1."""
    return (later - earlier + _HALF) % _WHOLE - _HALF


def extend32(clock32: int, near: Ticks) -> Ticks:
    """Return the 64-bit clock whose low bits are CLOCK32 and that is nearest to NEAR."""
    return Ticks(near + (clock32 - near + _HALF) % _WHOLE - _HALF)


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """A node's clock as a line through one point; good for extrapolation over a few seconds."""

    freq_hz: float
    at_ns: HostTime
    at_ticks: Ticks
    error_s: float
    """Bound of the error, from AT_NS to a second later, if the shortest delays out and back are equal."""
    asymmetry_s: float = 0.0
    """Further error if they differ: half the fastest exchange, if all its delay is in one direction."""

    @property
    def bound_s(self) -> float:
        """Bound of the total error: ``error_s`` plus what unequal delays may add undetected."""
        return self.error_s + self.asymmetry_s

    def ticks_at(self, at_ns: HostTime) -> Ticks:
        """Return the node's clock at host time AT_NS."""
        return Ticks(self.at_ticks + round((at_ns - self.at_ns) * (self.freq_hz * 1e-9)))

    def ns_at(self, ticks: Ticks) -> HostTime:
        """Return the host time at which the node's clock shows TICKS."""
        return HostTime(self.at_ns + round((ticks - self.at_ticks) * 1e9 / self.freq_hz))


class _Reading(NamedTuple):
    at_ns: HostTime
    ticks: Ticks
    round_trip_s: float


def _is_one_clock(first: _Reading, second: _Reading, freq_hz: float) -> bool:
    """Whether a clock of some FREQ_HZ can have been read as FIRST, and later as SECOND."""
    passed_s = (second.at_ns - first.at_ns) * 1e-9
    off_s = abs((second.ticks - first.ticks) / freq_hz - passed_s)
    return off_s <= (first.round_trip_s + second.round_trip_s) / 2 + RATE_SD * passed_s


class ClockEstimator:
    """Estimates one node's clock. NOMINAL_FREQ_HZ > 0 comes from its dictionary.

    ``begin`` with the answer to get_uptime, then ``add`` for every answer to get_clock or get_uptime.
    """

    def __init__(self, nominal_freq_hz: int) -> None:
        self._freq_hz = nominal_freq_hz
        self._round_trips_s: deque[float] = deque(maxlen=REMEMBERED)
        self._estimate: ClockEstimate | None = None
        # The first sample sets these, in _restart():
        self._zero_ns: int
        self._zero_ticks: int
        self._start: Start
        self._filter: Blend | None
        self._used: _Reading
        """The last one, set by the first sample."""
        self._impossible: deque[_Reading] = deque(maxlen=CONTRADICTIONS)
        """The last ones, since the last possible one."""
        self._contradictions = 0
        """How many there were."""
        self.jumps = 0
        """How often the clock has jumped since it was first known."""
        self.jump_s = 0.0
        """By how much it did the last time."""
        self._jump_found_ns = 0
        self.accepted = 0
        self.unusable = 0
        """Number of answers whose times are unknown (a repeated block), implausible or impossible."""

    @property
    def ready(self) -> bool:
        """Whether there are enough samples for planning, which reaches two seconds ahead."""
        return self.accepted >= SETTLE_SAMPLES

    @property
    def broken(self) -> bool:
        """Whether the clock is unusable: it contradicts the estimate, and itself, again and again."""
        return self._contradictions >= BROKEN

    @property
    def round_trip_s(self) -> float:
        """The fastest exchange remembered; 0 before the first."""
        return min(self._round_trips_s, default=0.0)

    def begin(self, sent_ns: int, received_ns: int, high: int, clock32: int) -> bool:
        """Start, or start again, with an answer to get_uptime. Return whether it was usable.

        Raises CanductorError when the node cannot have run for so long (UPTIME_MAX_S).
        """
        ticks = Ticks(high * _WHOLE + clock32 % _WHOLE)
        if not 0 <= ticks <= UPTIME_MAX_S * self._freq_hz:
            raise CanductorError(
                f"its clock cannot be right: an uptime of {ticks} ticks at {self._freq_hz} Hz; "
                "power-cycle it, and if that does not help flash its firmware again"
            )
        self._estimate = None
        self.accepted = 0
        return self._take(sent_ns, received_ns, ticks)

    def add(self, sent_ns: int, received_ns: int, clock32: int) -> bool:
        """Process the clock's low 32 bits as read: SENT_NS 0 means unknown. Return whether it was usable."""
        middle_ns = HostTime((sent_ns + received_ns) // 2)
        return self._take(sent_ns, received_ns, extend32(clock32, self.estimate().ticks_at(middle_ns)))

    def estimate(self) -> ClockEstimate:
        """Return the estimate as of the last sample; RuntimeError before ``begin``."""
        if self._estimate is None:
            raise RuntimeError("the clock was asked before its first sample")
        return self._estimate

    def ticks_at(self, at_ns: HostTime) -> Ticks:
        """Return the node's clock at host time AT_NS."""
        return (self._estimate or self.estimate()).ticks_at(at_ns)

    def ns_at(self, ticks: Ticks) -> HostTime:
        """Return the host time at which the node's clock shows TICKS."""
        return (self._estimate or self.estimate()).ns_at(ticks)

    def ahead_s(self, now_ns: int, clock32: int) -> float:
        """Return by how much a clock that was read before NOW_NS is ahead of all it can be; 0: it is not."""
        last = self.estimate()
        ticks = extend32(clock32, last.ticks_at(HostTime(now_ns)))
        ahead_s = (ticks - last.ticks_at(HostTime(now_ns))) / self._freq_hz
        return ahead_s if ahead_s > last.asymmetry_s + self._error_s(last, now_ns) else 0.0

    def jumped_lately_s(self, now_ns: int) -> float:
        """Return by how much the clock jumped, if that was found within LATELY_NS before NOW_NS, else 0."""
        lately = self.jumps and now_ns - self._jump_found_ns < LATELY_NS
        return self.jump_s if lately else 0.0

    @property
    def in_doubt(self) -> bool:
        """Return whether more samples are needed soon."""
        return self._contradictions > 0 or self.accepted < SETTLE_SAMPLES

    def next_sample_ns(self, now_ns: int) -> int:
        """Return when to query the node again after a query at NOW_NS."""
        if self.accepted < BURST_SAMPLES:
            return now_ns + BURST_INTERVAL_NS
        return now_ns + (SETTLE_INTERVAL_NS if self.in_doubt else SAMPLE_INTERVAL_NS)

    # ------------------------------------------------------------------------------------------------- fit

    def _take(self, sent_ns: int, received_ns: int, ticks: Ticks) -> bool:
        middle_ns = HostTime((sent_ns + received_ns) // 2)
        last = self._estimate
        if sent_ns <= 0 or received_ns <= sent_ns or (last is not None and middle_ns <= last.at_ns):
            self.unusable += 1
            return False
        round_trip_s = (received_ns - sent_ns) * 1e-9
        reading = _Reading(middle_ns, ticks, round_trip_s)
        if last is None or middle_ns - last.at_ns > GAP_NS:
            self._restart(middle_ns, ticks)
        elif self._is_impossible(last, reading):
            self._contradictions += 1
            self._impossible.append(reading)
            if not self._agree(last.freq_hz):
                self.unusable += 1
                return False
            # On a busy bus the answers may only show by how much the estimate was off, within their times.
            if not _is_one_clock(self._used, reading, last.freq_hz):
                self._note_jump((ticks - last.ticks_at(middle_ns)) / self._freq_hz, middle_ns)
            self._restart(middle_ns, ticks)
        self._forget_contradictions()
        self._used = reading
        self._round_trips_s.append(round_trip_s)
        self.accepted += 1
        self._fit(middle_ns, ticks, round_trip_s)
        return True

    def _restart(self, middle_ns: HostTime, ticks: Ticks) -> None:
        """Start again from this sample, without earlier knowledge."""
        self._zero_ns, self._zero_ticks = middle_ns, ticks
        self._start, self._filter = Start(), None
        self._round_trips_s.clear()

    def _is_impossible(self, last: ClockEstimate, reading: _Reading) -> bool:
        """Whether READING cannot lie between query and answer."""
        off_s = abs(reading.ticks - last.ticks_at(reading.at_ns)) / self._freq_hz
        return off_s > reading.round_trip_s / 2 + self._error_s(last, reading.at_ns)

    @staticmethod
    def _error_s(estimate: ClockEstimate, at_ns: int) -> float:
        """Return the bound of the error at AT_NS, after the estimate."""
        return estimate.error_s * (1 + (at_ns - estimate.at_ns) * 1e-9 / AHEAD_S)

    def _agree(self, freq_hz: float) -> bool:
        """Whether CONTRADICTIONS impossible readings are those of one clock."""
        first, *others = self._impossible
        return len(others) == CONTRADICTIONS - 1 and all(
            _is_one_clock(first, other, freq_hz) for other in others
        )

    def _note_jump(self, jump_s: float, found_ns: int) -> None:
        if abs(jump_s) >= JUMP_S:
            self.jumps += 1
            self.jump_s = jump_s
            self._jump_found_ns = found_ns

    def _forget_contradictions(self) -> None:
        self._impossible.clear()
        self._contradictions = 0

    def _fit(self, middle_ns: HostTime, ticks: Ticks, round_trip_s: float) -> None:
        faded_s = 0.0
        at_s = (middle_ns - self._zero_ns) * 1e-9
        lead_s = (ticks - self._zero_ticks) / self._freq_hz - at_s
        if self._filter is None:
            state, covariance = self._start.add(at_s, lead_s, round_trip_s)
            if self._start.samples >= START_SAMPLES:
                self._filter = Blend(Filter(state, covariance, at_s, self._start.spread_s))
        else:
            self._filter.add(at_s, lead_s, round_trip_s)
            state, covariance = self._filter.state, self._filter.covariance
            faded_s = self._filter.faded_s
        variance = covariance[0][0] + 2 * AHEAD_S * covariance[0][1] + AHEAD_S**2 * covariance[1][1]
        self._estimate = ClockEstimate(
            self._freq_hz * (1 + state[1]),
            middle_ns,
            Ticks(self._zero_ticks + round((at_s + state[0]) * self._freq_hz)),
            CONFIDENCE * math.sqrt(max(covariance[0][0], variance, 0.0)) + faded_s + 1e-6,
            self.round_trip_s / 2,
        )

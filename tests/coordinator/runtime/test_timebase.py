"""Print time against exactly known clocks."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from coordinator.runtime.timebase import SLEW_LIMIT, ClockJumpError, ClockPiece, JumpWatch, TimeBase
from coordinator.verification.planned import ticks_at
from nodes.clock.clock import ClockEstimator, HostTime, Ticks
from nodes.clock.pulse_fit import PulseFit
from nodes.clock.sync_pulse import PulseClock
from nodes.node.node import Node


class Clock:
    """An ideal estimate: exactly ticks = ticks0 + rate * (host time)."""

    def __init__(self, ticks0: float, rate: float) -> None:
        self.ticks0 = ticks0
        self.rate = rate

    def ticks_at(self, at_ns: HostTime, /) -> Ticks:
        return Ticks(round(self.ticks0 + self.rate * at_ns * 1e-9))

    def ns_at(self, ticks: Ticks, /) -> HostTime:
        return HostTime(round((ticks - self.ticks0) / self.rate * 1e9))


PRIMARY_FREQ = 168e6
SECONDARY_FREQ = 64e6


def base() -> TimeBase:
    return TimeBase(Clock(1e9, PRIMARY_FREQ * (1 - 20e-6)), PRIMARY_FREQ)


def test_print_time_is_the_primary_at_nominal_frequency() -> None:
    time_base = base()
    assert time_base.print_time_at(HostTime(0)) == pytest.approx(1e9 / PRIMARY_FREQ)
    assert time_base.host_ns_at(time_base.print_time_at(HostTime(123_456_789))) == pytest.approx(
        123_456_789, abs=10
    )


def test_secondary_map_follows_a_clock_that_was_seen_wrong_without_a_jump() -> None:
    time_base = base()
    seen = Clock(5e9, SECONDARY_FREQ * (1 + 200e-6))
    clock_map = time_base.secondary_map(seen, SECONDARY_FREQ, 100.0)
    seen.ticks0 += SECONDARY_FREQ * 400e-6  # the estimate improves by 400 µs
    moments = np.linspace(100.0, 106.0, 601)
    for moment in moments[::25]:
        time_base.steer("toolhead", clock_map, seen, float(moment))
    truth = np.array([seen.ticks_at(time_base.host_ns_at(float(m))) for m in moments])
    mapped = ticks_at(clock_map, moments)
    error_s = (mapped - truth) / SECONDARY_FREQ
    assert error_s[0] == pytest.approx(-400e-6, abs=1e-8)
    assert abs(error_s[-1]) < 2e-6
    slope = np.diff(mapped) / np.diff(moments) / (seen.rate * PRIMARY_FREQ / time_base._primary.rate)  # type: ignore[attr-defined]
    assert np.abs(slope - 1).max() <= SLEW_LIMIT * 1.01
    assert np.all(np.abs(np.diff(error_s)) < SLEW_LIMIT * 0.0101)


def test_a_clock_that_jumps_is_refused() -> None:
    time_base = base()
    seen = Clock(5e9, SECONDARY_FREQ)
    clock_map = time_base.secondary_map(seen, SECONDARY_FREQ, 100.0)
    seen.ticks0 += SECONDARY_FREQ * 0.02
    with pytest.raises(ClockJumpError, match=r"node toolhead is \+20\.0 ms"):
        time_base.steer("toolhead", clock_map, seen, 101.0)


def test_a_jump_counts_if_the_machine_moved_before_it() -> None:
    clock = ClockEstimator(168_000_000)
    node = cast("Node", SimpleNamespace(name="toolhead", clock=clock))
    watch = JumpWatch([node])
    watch.look(10.0, 10.5)
    watch.look(10.6, 10.5)
    clock.jumps = 1  # at rest: the host was suspended
    watch.look(11.0, 10.5)
    watch.look(11.5, 12.0)
    clock.jumps, clock.jump_s = 2, 0.8
    with pytest.raises(
        ClockJumpError, match=r"^the clock of node toolhead jumped by \+800\.0 ms during a move; "
    ):
        watch.look(12.3, 12.0)


def test_a_node_that_was_connected_again_has_another_clock_and_not_jumped() -> None:
    old, new = ClockEstimator(168_000_000), ClockEstimator(168_000_000)
    old.jumps = 1
    node = SimpleNamespace(name="toolhead", clock=old)
    watch = JumpWatch([cast("Node", node)])
    watch.look(10.0, 20.0)
    node.clock = new
    watch.look(11.0, 20.0)


def test_primary_map_is_exact() -> None:
    clock_map = base().primary_map(50.0)
    assert clock_map.last == ClockPiece(50.0, 50.0 * PRIMARY_FREQ, PRIMARY_FREQ)


def by_pulses(primary: Clock, secondary: Clock) -> PulseClock:
    """Return what pulses tell of SECONDARY after a minute."""
    fit = PulseFit(round(PRIMARY_FREQ), round(SECONDARY_FREQ))
    for moment in range(1, 61):
        at_ns = HostTime(moment * 1_000_000_000)
        fit.add(primary.ticks_at(at_ns), secondary.ticks_at(at_ns))
    assert fit.line is not None
    return PulseClock(primary, fit.line)


class Restless(Clock):
    """An estimate that is renewed, and moves by 100 µs, whenever one has looked at it: by another thread."""

    def ns_at(self, ticks: Ticks, /) -> HostTime:
        found = super().ns_at(ticks)
        self.ticks0 += 100e-6 * PRIMARY_FREQ
        return found


def test_by_pulses_the_primarys_estimate_has_no_part_even_while_it_changes() -> None:
    primary, secondary = Restless(1e9, PRIMARY_FREQ * (1 - 20e-6)), Clock(5e9, SECONDARY_FREQ * (1 + 70e-6))
    pulses = by_pulses(primary, secondary)
    begin = primary.ticks_at(HostTime(61_000_000_000)) / PRIMARY_FREQ
    time_base = TimeBase(primary, PRIMARY_FREQ)
    clock_map = time_base.secondary_map(pulses, SECONDARY_FREQ, begin)
    piece = time_base.steer("toolhead", clock_map, pulses, begin + 1)
    assert piece.ticks == pytest.approx(secondary.ticks_at(HostTime(62_000_020_000)), abs=3)
    assert piece.ticks_per_s == pytest.approx(SECONDARY_FREQ * (1 + 90e-6), rel=0.1e-6)


def test_the_change_from_exchanges_to_pulses_and_back_bends_but_never_jumps() -> None:
    primary, secondary = Clock(1e9, PRIMARY_FREQ * (1 - 20e-6)), Clock(5e9, SECONDARY_FREQ * (1 + 70e-6))
    time_base, pulses = TimeBase(primary, PRIMARY_FREQ), by_pulses(primary, secondary)
    exchanges = Clock(secondary.ticks0 + 30e-6 * SECONDARY_FREQ, secondary.rate)
    begin = time_base.print_time_at(HostTime(60_000_000_000))
    clock_map = time_base.secondary_map(exchanges, SECONDARY_FREQ, begin)
    moments = begin + np.arange(0, 20, 0.05)
    for n, moment in enumerate(moments):
        time_base.steer("toolhead", clock_map, pulses if 100 <= n < 300 else exchanges, float(moment))
    truth = np.array([secondary.ticks_at(time_base.host_ns_at(float(m))) for m in moments])
    error_s = (ticks_at(clock_map, moments) - truth) / SECONDARY_FREQ
    assert error_s[100] == pytest.approx(30e-6, abs=0.1e-6)
    assert abs(error_s[300]) < 0.1e-6
    assert error_s[-1] == pytest.approx(30e-6, abs=0.4e-6)  # e^-5 of the way is left
    # Never faster than the whole difference over a second: 30 µs per s.
    assert np.abs(np.diff(error_s)).max() / 0.05 < 31e-6

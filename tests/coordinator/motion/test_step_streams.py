"""Node clocks, queue slots, the merged streams, and what is refused."""

import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
import pytest

from coordinator.motion.specs import StepperSpec
from coordinator.motion.steps.errors import StepError
from coordinator.motion.steps.steps import StepGenerator
from tests.coordinator.motion.steps_harness import (
    MAX_ERROR_S,
    NOISE_S,
    ORIGIN,
    E,
    Run,
    X,
    Y,
    Z,
    compare,
    node_spec,
    rows,
    stepper,
)
from tests.coordinator.motion.steps_oracle import Move, Position, make_move, step_times

HOLD_S = 0.05
"""STEP_HOLD_S: what may be held back, besides a step that may get a neighbour."""


def test_clocks_roll_over_on_the_wire() -> None:
    moves = [make_move(10.0, ORIGIN, (30.0, 0.0, 0.0, 0.0), (0.0, 10.0, 0.0), 1000.0)]
    run = Run([stepper(0, X)], [node_spec()])
    ticks = (5 << 32) - 168_000_000
    run.gen.set_clock_base(0, 10.0, ticks, 168e6)
    run.play(moves)
    clocks = np.array([clock for clock, _ in run.steps(0)])
    assert clocks[0] < 5 << 32 < clocks[-1]
    wanted = step_times(run.steppers[0], 168e6, moves, ORIGIN, MAX_ERROR_S)
    compare([(int(c) - ticks + 1_680_000_000, d) for c, d in run.steps(0)], wanted, 168e6)
    run.check_nodes()


def test_long_rests_are_bridged_by_a_reset() -> None:
    moves, t = [], 1.0
    for i in range(4):
        at: Position = (i * 0.5, 0.0, 0.0, 0.0)
        moves.append(make_move(t, at, ((i + 1) * 0.5, 0.0, 0.0, 0.0), (0.0, 20.0, 0.0), 1000.0))
        t += 1000.0
    run = Run([stepper(0, X)], [node_spec()])
    run.play(moves)
    run.check(moves)
    resets = [r for r in run.nodes[0].records if r.name == "reset_step_clock"]
    assert len(resets) == 4
    assert resets[0].min_clock == 0


def test_crawling_needs_a_reset_for_every_step() -> None:
    moves = [make_move(1.0, ORIGIN, (0.05, 0.0, 0.0, 0.0), (0.0, 0.0005, 0.0), 1000.0)]
    run = Run([stepper(0, X)], [node_spec()])
    run.play(moves)
    run.check(moves)
    assert sum(r.name == "reset_step_clock" for r in run.nodes[0].records) == 8


def test_a_changed_clock_is_continuous_and_acts_from_the_border() -> None:
    moves = [make_move(1.0, ORIGIN, (40.0, 0.0, 0.0, 0.0), (0.0, 10.0, 0.0), 1000.0)]
    run = Run([stepper(0, X)], [node_spec()])
    assert run.gen.append(rows(moves), 1) == 1
    rates = [168e6, 168e6 * 1.0002, 168e6 * 0.9999, 168e6]
    borders = [2.0, 3.0, 4.0]
    for rate, border in zip(rates[1:], borders, strict=True):
        assert run.gen.generate(border)
        before = run.gen.clock_at(0, border)
        run.gen.set_clock(0, rate)
        assert abs(run.gen.clock_at(0, border) - before) <= 1
    assert run.gen.generate(10.0, flush=True)
    run.collect()
    ticks = 168e6 * 2 + rates[1] + rates[2]
    wanted = step_times(run.steppers[0], 168e6, moves, ORIGIN, MAX_ERROR_S)
    done = run.steps(0)
    assert len(done) == len(wanted)
    for (clock, _), step in zip(done, wanted, strict=True):
        since = [min(max(step.time - b, 0.0), 1.0) for b in (2.0, 3.0)]
        true = 168e6 * min(step.time, 2.0) + rates[1] * since[0] + rates[2] * since[1]
        true += rates[3] * max(step.time - 4.0, 0.0)
        assert abs(clock - true) <= (step.band_s + NOISE_S) * 168e6
    assert abs(run.gen.clock_at(0, 4.0) - ticks) <= 1


def test_clock_error_stays_below_a_tenth_of_a_tick_for_ten_hours() -> None:
    run = Run([stepper(0, X)], [node_spec()])
    rate = 168_000_003.7
    run.gen.set_clock_base(0, 0.0, 12345, rate)
    t = 0.0
    while t < 36_000:
        t += 17.3
        assert run.gen.generate(t)
        exact = 12345 + Fraction(t) * Fraction(rate)
        tenth = Fraction(1, 10)
        assert math.floor(exact - tenth) <= run.gen.clock_at(0, t) <= math.floor(exact + tenth)


@pytest.mark.parametrize("move_count", [1, 3, 16])
def test_queue_slots_never_overflow(move_count: int) -> None:
    moves, t, at = [], 1.0, ORIGIN
    rng = np.random.default_rng(move_count)
    for _ in range(30):
        x, y, z, e = (float(v) for v in rng.uniform(-2, 2, 4))
        moves.append(make_move(t, at, (x, y, z, e), (0.0, 20.0, 0.0), 3000.0))
        t, at = t + moves[-1].total_s, (x, y, z, e)
    node = node_spec(move_count=move_count)
    run = Run([stepper(i, w) for i, w in enumerate((X, Y, Z, E))], [node])
    run.play(moves)
    run.check(moves)
    used = run.nodes[0].check_slots()
    stats = run.gen.stats().nodes[0]
    assert used == move_count
    assert stats.max_slots == min(move_count, 4) or move_count == 16
    assert (stats.late_slots > 0) == (move_count < 4)


def test_small_batches_and_a_full_output_lose_nothing() -> None:
    moves, t = [], 1.0
    for i in range(4000):
        a, b = ((0.0, 0.3), (0.3, 0.0))[i % 2]
        moves.append(make_move(t, (a, 0.0, 0.0, 0.0), (b, 0.0, 0.0, 0.0), (0.0, 100.0, 0.0), 3000.0))
        t += moves[-1].total_s
    run = Run([stepper(0, X)], [node_spec()])
    assert run.gen.append(rows(moves), len(moves)) == len(moves)
    calls = 0
    while not run.gen.generate(t, flush=True):
        calls += 1
        assert run.gen.stats().nodes[0].waiting_bytes > 200_000
        run.collect(100)
    run.collect(100)
    assert calls > 0
    assert sum(d for _, d in run.steps(0)) == 0
    assert len(run.steps(0)) == 4000 * 48
    run.check_nodes()


@pytest.mark.parametrize(("y_mm", "accel"), [(0.6, 50.0), (2.0, 1000.0), (4.0, 200.0), (6.0, 1000.0)])
def test_a_slow_axis_holds_nothing_back_for_long(y_mm: float, accel: float) -> None:
    """A move nearly along X: a command of Y may last for long, and those of X behind it wait for it."""
    moves = [make_move(1.0, ORIGIN, (100.0, y_mm, 0.0, 0.0), (0.0, 50.0, 0.0), accel)]
    steppers = [stepper(0, X, 0.0125), stepper(1, Y, 0.0125)]
    wanted = [step_times(s, 168e6, moves, ORIGIN, MAX_ERROR_S) for s in steppers]
    for border in np.linspace(1.1, moves[0].print_time + moves[0].total_s, 40):
        run = Run(steppers, [node_spec()])
        assert run.gen.append(rows(moves), 1) == 1
        assert run.gen.generate(border)
        run.collect()
        for index, steps in enumerate(wanted):
            left = steps[len(run.steps(index)) :]
            assert not left or left[0].time > border - 2 * HOLD_S


def test_the_ring_says_when_it_is_full() -> None:
    moves = [
        make_move(1.0 + i, (i * 0.1, 0.0, 0.0, 0.0), ((i + 1) * 0.1, 0.0, 0.0, 0.0), (0.0, 10.0, 0.0), 500.0)
        for i in range(5000)
    ]
    run = Run([stepper(0, X, 0.1)], [node_spec()])
    taken = run.gen.append(rows(moves), 5000)
    assert 0 < taken < 5000
    assert run.gen.append(rows(moves[taken:]), 5000 - taken) == 0
    assert StepGenerator([], [node_spec()]).append(rows(moves[:3]), 7) == 3, "no further than the buffer"
    while not run.gen.generate(float(taken)):
        run.collect()
    assert run.gen.append(rows(moves[taken:]), 5000 - taken) == 5000 - taken
    while not run.gen.generate(6000.0, flush=True):
        run.collect()
    run.collect()
    assert [d for _, d in run.steps(0)] == [1] * 5000
    run.check_nodes()


def test_setting_the_axes_makes_no_step() -> None:
    run = Run([stepper(0, X)], [node_spec()])
    first = [make_move(1.0, ORIGIN, (1.234, 0.0, 0.0, 0.0), (0.0, 10.0, 0.0), 500.0)]
    assert run.gen.append(rows(first), 1) == 1
    with pytest.raises(StepError, match="while moves wait"):
        run.gen.set_axis_position((200.0, 0.0, 0.0, 0.0))
    assert run.gen.generate(2.0, flush=True)
    run.gen.set_axis_position((200.0, 0.0, 0.0, 0.0))
    assert run.gen.position(0) == 197
    second = make_move(3.0, (200.0, 0.0, 0.0, 0.0), (199.0, 0.0, 0.0, 0.0), (0.0, 10.0, 0.0), 500.0)
    assert run.gen.append(rows([second]), 1) == 1
    assert run.gen.generate(4.0, flush=True)
    run.collect()
    assert run.gen.position(0) == sum(d for _, d in run.steps(0)) == 197 - 160


def failing(moves: Sequence[Move], steppers: Sequence[StepperSpec]) -> StepGenerator:
    gen = StepGenerator(steppers, [node_spec()])
    assert gen.append(rows(moves), len(moves)) == len(moves)
    return gen


def test_errors_are_sentences() -> None:
    fast = make_move(1.0, ORIGIN, (50.0, 0.0, 0.0, 0.0), (0.0, 300.0, 0.0), 5000.0)
    with pytest.raises(StepError, match=r"s0 at print time .* closer than the step pulse allows"):
        failing([fast], [stepper(0, X, 0.001)]).generate(9.0, flush=True)
    jump = make_move(1.0, (1.0, 0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0), (0.0, 30.0, 0.0), 5000.0)
    with pytest.raises(StepError, match=r"begins \+160.000 steps from where the stepper stands"):
        failing([jump], [stepper(0, X)]).generate(9.0, flush=True)
    with pytest.raises(StepError, match="follow each other in time"):
        failing([fast, fast], [stepper(0, X)])
    bad = rows([fast])
    bad[0, 4] = math.nan
    with pytest.raises(StepError, match="impossible numbers"):
        StepGenerator([stepper(0, X)], [node_spec()]).append(bad, 1)
    with pytest.raises(StepError, match="out of range"):
        StepGenerator([stepper(0, X, 0.0)], [node_spec()])
    gen = StepGenerator([stepper(0, X)], [node_spec()])
    with pytest.raises(StepError, match="no possible clock"):
        gen.set_clock(0, math.nan)
    with pytest.raises(StepError, match="there is no node 1"):
        gen.take_batch(1)

"""Step generation against its slow twin: every step, its direction, its clock."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.motion.steps._steps import lib
from coordinator.motion.steps.steps import SHORT_S, StepGenerator
from tests.coordinator.motion.steps_harness import (
    MACHINES,
    MAX_ERROR_S,
    ORIGIN,
    Run,
    X,
    node_spec,
    rows,
    stepper,
)
from tests.coordinator.motion.steps_oracle import Move, fewest_segments, make_move, step_times
from tests.profiles import examples

# -------------------------------------------------------------------------------------------- strategies

# Coordinates on a coarse grid fall on half steps often; free ones never do.
grid = st.integers(-400, 400).map(lambda n: n * 0.003125)
free = st.floats(-2, 2, allow_nan=False)
coordinate = st.one_of(grid, free)
speed = st.floats(0.5, 250)


@st.composite
def chains(draw: st.DrawFn) -> list[Move]:
    moves: list[Move] = []
    t, at, joint = draw(st.floats(0.3, 9)), ORIGIN, 0.0
    for _ in range(draw(st.integers(1, 6))):
        axes = draw(st.sampled_from(["xyze", "xy", "x", "z", "e", "xe"]))
        end = tuple(draw(coordinate) if axis in axes else at[i] for i, axis in enumerate("xyze"))
        way = math.dist(end[:3], at[:3])
        if way < 1e-3 and (way > 0 or abs(end[3] - at[3]) < 1e-3):
            continue
        limit = 10.0 if "z" in axes else 250.0
        cruise = min(draw(speed), limit, 60.0 * (way or 1.0) / (abs(end[3] - at[3]) + 1e-9))
        speeds = (min(joint, cruise), cruise, draw(st.sampled_from([0.0, 5.0, cruise])))
        move = make_move(t, at, (end[0], end[1], end[2], end[3]), speeds, draw(st.floats(100, 9000)))
        moves.append(move)
        joint = move.cruise_v - move.accel * move.seconds[2]
        # As a planner does: the next move begins where this one was meant to end.
        at = (end[0], end[1], end[2], end[3])
        t += move.total_s + draw(st.sampled_from([0.0, 0.0, 0.0, 0.2, 30.0]))
    return moves


cut_shares = st.lists(st.tuples(st.floats(0, 1), st.booleans()), max_size=6)


@pytest.mark.parametrize("machine", MACHINES)
@given(moves=chains(), longest_s=st.sampled_from([0.0, SHORT_S]))
@settings(max_examples=examples(40))
def test_every_step_is_in_its_band(machine: str, moves: list[Move], longest_s: float) -> None:
    if not moves:
        return
    run = Run(MACHINES[machine], longest_s=longest_s)
    run.play(moves)
    run.check(moves)


@given(moves=chains(), shares=cut_shares)
@settings(max_examples=examples(60))
def test_generating_in_pieces_changes_no_step(moves: list[Move], shares: list[tuple[float, bool]]) -> None:
    if not moves:
        return
    run = Run(MACHINES["cartesian"])
    begin, end = moves[0].print_time, moves[-1].print_time + moves[-1].total_s
    run.play(moves, [(begin + share * (end - begin), flush) for share, flush in shares])
    run.check(moves, flushed=True)


def back_and_forth(turn: float, *, rest_s: float = 0.0, accel: float = 1000.0) -> list[Move]:
    first = make_move(1.0, ORIGIN, (turn, 0.0, 0.0, 0.0), (0.0, 50.0, 0.0), accel)
    t = 1.0 + first.total_s + rest_s
    second = make_move(t, (turn, 0.0, 0.0, 0.0), ORIGIN, (0.0, 50.0, 0.0), accel)
    return [first, second]


@pytest.mark.parametrize("steps", [0.5, 1.5, 10.5, 100.5])
def test_turning_exactly_on_a_boundary_makes_no_pair_of_steps(steps: float) -> None:
    for turn, rounding in ((steps, 0.5), (-steps, -0.5)):
        moves = back_and_forth(turn * 0.00625)
        run = Run([stepper(0, X)], [node_spec()])
        run.play(moves)
        run.check(moves)
        # Upward the boundary belongs to the step above, but a step and its opposite at one time annul.
        assert len(run.steps(0)) == 2 * abs(int(turn - rounding))


def test_a_rest_at_a_half_step_stays_where_it_came_from() -> None:
    for turn, there in ((10.5, 10), (-10.5, -10), (10.5 + 5e-7, 10), (10.5 + 2e-6, 11), (10.5 - 2e-6, 10)):
        moves = back_and_forth(turn * 0.00625, rest_s=1.0)
        run = Run([stepper(0, X)], [node_spec()])
        run.play(moves)
        run.check(moves)
        assert len(run.steps(0)) == 2 * abs(there)
        forth = [d for clock, d in run.steps(0) if clock < 168_000_000 * (moves[1].print_time - 0.5)]
        assert sum(forth) == there


def test_a_flush_between_two_opposite_steps_puts_the_second_off() -> None:
    moves = back_and_forth((10.5 + 2e-6) * 0.00625, accel=1e5)
    run = Run([stepper(0, X)], [node_spec()])
    run.play(moves, [(moves[1].print_time, True)])
    clocks = [clock for clock, _ in run.steps(0)]
    assert [d for _, d in run.steps(0)] == [1] * 11 + [-1] * 11
    assert clocks[11] - clocks[10] >= 2 * 2e-6 * 168e6
    assert abs(clocks[11] / 168e6 - moves[1].print_time) < MAX_ERROR_S
    assert run.gen.stats().steppers[0].put_off == 1


def test_a_batch_is_full_while_the_longest_segment_would_still_fit() -> None:
    """Nothing may be written beyond a batch's end, whatever the next segment takes."""
    longest = 3 * (17 + 2 * 5 + 3 * 5)  # three commands: a record's header, id and oid, values
    gen = StepGenerator([stepper(0, X)], [node_spec()])
    t, made = 1.0, 0
    for full in range(3):
        while True:
            move = make_move(t, ORIGIN, (0.05, 0.0, 0.0, 0.0), (0.0, 5.0, 0.0), 9000)
            back = make_move(t + move.total_s, move.end, ORIGIN, (0.0, 5.0, 0.0), 9000)
            t += move.total_s + back.total_s
            assert gen.append(rows([move, back]), 2) == 2
            if not gen.generate(t):
                break
        stats = gen.stats()
        room = lib.STEP_OUT_BYTES - stats.nodes[0].waiting_bytes
        made = max(made, stats.nodes[0].waiting_bytes // stats.steppers[0].queue_steps)
        assert longest - 2 * made < room < longest, full
        while gen.take_batch(0):
            pass


def test_segments_are_close_to_the_fewest_possible(record_property: Callable[[str, object], None]) -> None:
    """Tiny inputs on a slow clock: 100 kHz, 60 us of tolerance; the optimum is exact."""
    node, ours, best = node_spec(freq=100_000), 0, 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        x = float(rng.uniform(0.5, 2.0))
        speeds = (0.0, float(rng.uniform(5, 60)), 0.0)
        moves = [make_move(1.0, ORIGIN, (x, 0.0, 0.0, 0.0), speeds, float(rng.uniform(50, 2000)))]
        run = Run([stepper(0, X, 0.025)], [node], max_error_s=60e-6)
        run.play(moves)
        run.check(moves)
        wanted = step_times(run.steppers[0], 100e3, moves, ORIGIN, 60e-6)
        bands = [
            (math.ceil((s.time - s.band_s) * 1e5), math.floor((s.time + s.band_s) * 1e5)) for s in wanted
        ]
        begin = next(r.req_clock for r in run.nodes[0].records)
        best += fewest_segments(bands, begin)
        ours += run.gen.stats().steppers[0].queue_steps
    record_property("segments_over_optimum", ours / best)
    assert best <= ours <= 1.1 * best

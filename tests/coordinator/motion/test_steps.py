"""Step generation against its slow twin: every step, its direction, its clock, its slot."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.motion.specs import NodeStreamSpec, StepperSpec
from coordinator.motion.steps import StepError, StepGenerator, resting_step
from tests.coordinator.motion.steps_oracle import (
    Move,
    Node,
    Position,
    Step,
    fewest_segments,
    make_move,
    step_times,
)

ORIGIN: Position = (0.0, 0.0, 0.0, 0.0)
MAX_ERROR_S = 12.5e-6
# At a standstill a step's time is ill-conditioned: 1e-13 mm are worth some 5 ns.
NOISE_S = 5e-8


def node_spec(name: str = "main", freq: int = 168_000_000, move_count: int = 1024) -> NodeStreamSpec:
    return NodeStreamSpec(name, freq, move_count, 21, 200, -5)


def stepper(
    oid: int,
    weights: tuple[float, float, float, float],
    distance: float = 0.00625,
    *,
    node: int = 0,
    invert: bool = False,
    pulse_s: float = 2e-6,
) -> StepperSpec:
    return StepperSpec(f"s{oid}", node, oid, weights, distance, invert, pulse_s)


X = (1.0, 0.0, 0.0, 0.0)
Y = (0.0, 1.0, 0.0, 0.0)
Z = (0.0, 0.0, 1.0, 0.0)
E = (0.0, 0.0, 0.0, 1.0)
MACHINES = {
    "cartesian": [
        stepper(0, X),
        stepper(1, Y, 0.01, invert=True),
        stepper(2, Z, 0.0025, pulse_s=0.0),
        stepper(3, E, 0.001417, node=1),
    ],
    "corexy": [stepper(0, (1.0, 1.0, 0.0, 0.0)), stepper(1, (1.0, -1.0, 0.0, 0.0), node=1)],
}
NODES = [node_spec(), node_spec("tool", 64_000_000, 16)]


def rows(moves: Sequence[Move]) -> "np.ndarray[tuple[int, int], np.dtype[np.float64]]":
    return np.array([move.row() for move in moves])


class Run:
    """A generator and the nodes it feeds."""

    def __init__(
        self,
        steppers: Sequence[StepperSpec],
        nodes: Sequence[NodeStreamSpec] = NODES,
        *,
        start: Position = ORIGIN,
        max_error_s: float = MAX_ERROR_S,
    ) -> None:
        self.steppers, self.specs, self.start, self.max_error_s = steppers, nodes, start, max_error_s
        self.gen = StepGenerator(steppers, nodes, start=start, max_error_s=max_error_s)
        self.nodes = [
            Node(spec, [s for s in steppers if s.node == i]) for i, spec in enumerate(nodes)
        ]

    def collect(self, room: int = 4096) -> None:
        for i, node in enumerate(self.nodes):
            while batch := self.gen.take_batch(i, room):
                node.execute(batch)

    def play(self, moves: Sequence[Move], cuts: Sequence[tuple[float, bool]] = ()) -> None:
        assert self.gen.append(rows(moves), len(moves)) == len(moves)
        end = moves[-1].print_time + moves[-1].total_s
        for until, flush in [*sorted(cuts), (end, False), (end, True)]:
            while not self.gen.generate(until, flush=flush):
                self.collect()
            self.collect()

    def steps(self, index: int) -> list[tuple[int, int]]:
        s = self.steppers[index]
        return self.nodes[s.node].motors[s.oid].steps

    def check(self, moves: Sequence[Move], *, flushed: bool = False) -> None:
        for i, spec in enumerate(self.steppers):
            freq = self.specs[spec.node].clock_freq
            wanted = step_times(spec, freq, moves, self.start, self.max_error_s)
            done = self.steps(i)
            if not (flushed and len(done) != len(wanted)):
                compare(done, wanted, freq)
            position = sum(direction for _, direction in done)
            assert position == resting_step(spec, self.start, moves[-1].end) == self.gen.position(i)
            shortest = max(math.ceil(2 * spec.step_pulse_s * freq), 1)
            clocks = [clock for clock, _ in done]
            assert all(b - a >= shortest for a, b in zip(clocks, clocks[1:], strict=False))
        self.check_nodes()

    def check_nodes(self) -> None:
        stats = self.gen.stats()
        for node, counted in zip(self.nodes, stats.nodes, strict=True):
            assert node.check_slots() <= node.spec.move_count
            req = [record.req_clock for record in node.records]
            assert req == sorted(req)
            assert counted.framed_bytes == node.framed_bytes()
            assert counted.commands == len(node.records)
            assert counted.content_bytes == sum(record.size for record in node.records)
        for i, s in enumerate(stats.steppers):
            mine = [r for r in self.nodes[self.steppers[i].node].records if r.oid == self.steppers[i].oid]
            assert s.steps == len(self.steps(i))
            assert s.issued == sum(direction for _, direction in self.steps(i))
            assert s.queue_steps == sum(r.name == "queue_step" for r in mine)
            assert s.direction_changes == sum(r.name == "set_next_step_dir" for r in mine)
            assert s.commands == len(mine)
            assert s.content_bytes == sum(r.size for r in mine)


def compare(done: list[tuple[int, int]], wanted: list[Step], freq: float) -> None:
    assert [d for _, d in done] == [s.direction for s in wanted]
    for (clock, _), step in zip(done, wanted, strict=True):
        assert abs(clock / freq - step.time) <= step.band_s + NOISE_S


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
@given(moves=chains())
@settings(max_examples=40, deadline=None)
def test_every_step_is_in_its_band(machine: str, moves: list[Move]) -> None:
    if not moves:
        return
    run = Run(MACHINES[machine])
    run.play(moves)
    run.check(moves)


@given(moves=chains(), shares=cut_shares)
@settings(max_examples=60, deadline=None)
def test_generating_in_pieces_changes_no_step(moves: list[Move], shares: list[tuple[float, bool]]) -> None:
    if not moves:
        return
    run = Run(MACHINES["cartesian"])
    begin, end = moves[0].print_time, moves[-1].print_time + moves[-1].total_s
    run.play(moves, [(begin + share * (end - begin), flush) for share, flush in shares])
    run.check(moves, flushed=True)


def back_and_forth(turn: float, *, rest_s: float = 0.0) -> list[Move]:
    first = make_move(1.0, ORIGIN, (turn, 0.0, 0.0, 0.0), (0.0, 50.0, 0.0), 1000.0)
    t = 1.0 + first.total_s + rest_s
    second = make_move(t, (turn, 0.0, 0.0, 0.0), ORIGIN, (0.0, 50.0, 0.0), 1000.0)
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


def test_resting_exactly_on_a_boundary_rounds_up() -> None:
    for turn, there in ((10.5, 11), (-10.5, -10)):
        moves = back_and_forth(turn * 0.00625, rest_s=1.0)
        run = Run([stepper(0, X)], [node_spec()])
        run.play(moves)
        run.check(moves)
        assert len(run.steps(0)) == 2 * abs(there)
        forth = [d for clock, d in run.steps(0) if clock < 168_000_000 * (moves[1].print_time - 0.5)]
        assert sum(forth) == there


def test_a_flush_between_two_opposite_steps_puts_the_second_off() -> None:
    moves = back_and_forth(10.5 * 0.00625)
    run = Run([stepper(0, X)], [node_spec()])
    run.play(moves, [(moves[1].print_time, True)])
    clocks = [clock for clock, _ in run.steps(0)]
    assert [d for _, d in run.steps(0)] == [1] * 11 + [-1] * 11
    assert clocks[11] - clocks[10] >= 2 * 2e-6 * 168e6
    assert abs(clocks[11] / 168e6 - moves[1].print_time) < MAX_ERROR_S
    assert run.gen.stats().steppers[0].put_off == 1


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
        exact = 12345 + int(np.floor(LONG(t) * LONG(rate)))
        assert abs(run.gen.clock_at(0, t) - exact) <= 1
    # Rounded down a tenth of a tick shows in one of ten; so far, none differs by more than the rounding.


LONG = np.longdouble


@pytest.mark.parametrize("move_count", [1, 2, 3, 16])
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


def test_timed_commands_are_merged_by_their_clock() -> None:
    moves = [make_move(1.0, ORIGIN, (5.0, 0.0, 0.0, 0.0), (0.0, 10.0, 0.0), 200.0)]
    run = Run([stepper(0, X)], [node_spec()])
    clocks = [int(168e6 * t) for t in (1.2, 1.1, 1.3)]
    for clock in clocks:
        run.gen.add_timed(0, clock, clock, bytes([77, clock % 50]))
    run.play(moves)
    run.check_nodes()
    assert [(req, p) for _, req, p in run.nodes[0].other] == [
        (clock, bytes([77, clock % 50])) for clock in sorted(clocks)
    ]
    with pytest.raises(StepError, match="60 bytes is refused"):
        run.gen.add_timed(0, 1, 1, bytes(60))
    with pytest.raises(StepError, match="timed commands wait already"):
        for _ in range(2000):
            run.gen.add_timed(0, 1 << 40, 1 << 40, b"x")


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


def test_the_ring_says_when_it_is_full() -> None:
    moves = [
        make_move(1.0 + i, (i * 0.1, 0.0, 0.0, 0.0), ((i + 1) * 0.1, 0.0, 0.0, 0.0), (0.0, 10.0, 0.0), 500.0)
        for i in range(5000)
    ]
    run = Run([stepper(0, X, 0.1)], [node_spec()])
    taken = run.gen.append(rows(moves), 5000)
    assert 0 < taken < 5000
    assert run.gen.append(rows(moves[taken:]), 5000 - taken) == 0
    while not run.gen.generate(float(taken)):
        run.collect()
    assert run.gen.append(rows(moves[taken:]), 5000 - taken) == 5000 - taken
    while not run.gen.generate(6000.0, flush=True):
        run.collect()
    run.collect()
    run.check(moves)


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


def test_segments_are_close_to_the_fewest_possible(capsys: pytest.CaptureFixture[str]) -> None:
    """Tiny inputs on a slow clock: 100 kHz, 60 us of tolerance; reports how far from the optimum."""
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
    with capsys.disabled():
        print(f"\nsegments: {ours}, fewest possible: {best}, {100 * (ours / best - 1):.1f} % above")
    assert ours <= 1.35 * best

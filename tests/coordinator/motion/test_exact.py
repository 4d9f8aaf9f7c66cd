"""The proof's own parts: each against a slower definition, and that it finds what is wrong."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from coordinator.verification.exact_path import INVERSE, Leg, Setting, StepperPath, places, solve
from coordinator.verification.exact_signal import Floats, Phases, Shaped, Smoothed
from tests.coordinator.motion.exact_cases import AWAY, LINEAR, PARAMS, SETTING, chain, spec_of, trapezoids
from tests.coordinator.motion.exact_check import Epoch, StepperProof, check
from tests.coordinator.motion.replay import Stream, replay, replay_all
from tests.coordinator.motion.steps_harness import MACHINES, NODES, ORIGIN, Run, X, stepper
from tests.coordinator.motion.steps_oracle import Move, make_move

FREQ = 168_000_000


def executed(seed: int) -> tuple[Run, list[Move], dict[str, Stream]]:
    moves = chain(seed, 60)
    run = Run(MACHINES["cartesian"])
    batches = {i: bytearray() for i in range(len(NODES))}
    assert run.gen.append(np.array([m.row() for m in moves]), len(moves)) == len(moves)
    while not run.gen.generate(moves[-1].print_time + moves[-1].total_s, flush=True):
        pass
    for i, node in enumerate(run.nodes):
        while batch := run.gen.take_batch(i):
            node.execute(batch)
            batches[i] += batch
    streams = replay_all({i: bytes(b) for i, b in batches.items()}, NODES, MACHINES["cartesian"])
    return run, moves, streams


# ------------------------------------------------------------------------------------------- replay


@pytest.mark.parametrize("seed", range(3))
def test_the_replay_does_what_a_node_does(seed: int) -> None:
    run, _, streams = executed(seed)
    for i, spec in enumerate(run.steppers):
        clock, direction, position = streams[spec.name].expand()
        assert list(zip(clock.tolist(), direction.tolist(), strict=True)) == run.steps(i)
        assert position.tolist() == [0, *itertools.accumulate(direction.tolist())][: len(position)]
        pieces = [c.expand()[0] for c in streams[spec.name].chunks(500)]
        assert len(pieces) > 1 or len(clock) <= 500
        assert np.concatenate([*pieces, np.empty(0, np.int64)]).tolist() == clock.tolist()


def test_a_replay_refuses_what_a_node_cannot_follow() -> None:
    run, _, _ = executed(0)
    queued = next(r for r in run.nodes[0].records if r.name == "queue_step")
    spec = run.steppers[0]
    record = bytes(8) + queued.req_clock.to_bytes(8, "little") + bytes([5, 21, spec.oid, 40, 2, 0])
    with pytest.raises(AssertionError, match="before the first direction"):
        replay(record, NODES[0], [spec])
    with pytest.raises((AssertionError, IndexError)):
        replay(record[:-1], NODES[0], [spec])


# ------------------------------------------------------------------------------------------ signals


def test_phases_are_the_trapezoids() -> None:
    moves = chain(3, 40)
    phases = Phases.of(ORIGIN, trapezoids(moves))
    for axis in range(4):
        signal = phases.mix([float(i == axis) for i in range(4)])
        for move in moves:
            t = np.linspace(0, move.total_s, 9)
            way = move.way(t.astype(np.longdouble)).astype(np.float64)
            wanted = move.start[axis] + move.ratio[axis] * way
            assert signal.at(move.print_time + t) == pytest.approx(wanted, abs=1e-9)
            h = 1e-6
            slope = (signal.at(move.print_time + t + h) - signal.at(move.print_time + t - h)) / (2 * h)
            assert signal.slope(move.print_time + t[1:-1]) == pytest.approx(slope[1:-1], abs=0.2)
    end = moves[-1].print_time + moves[-1].total_s
    assert phases.mix([1.0, 0, 0, 0]).at(np.array([0.0, end + 5])) == pytest.approx([0.0, moves[-1].end[0]])


def by_quadrature(phases: Phases, half_s: float, t: float) -> float:
    """Return the window's integral by Gauss and Legendre on every smooth piece: exact for these degrees."""
    signal = phases.advanced()
    cuts = signal.time[(signal.time > t - half_s) & (signal.time < t + half_s)]
    cuts = np.unique(np.concatenate(([t - half_s, t, t + half_s], cuts)))
    node, weight = np.polynomial.legendre.leggauss(5)
    total = 0.0
    for a, b in itertools.pairwise(cuts):
        at = (a + b) / 2 + (b - a) / 2 * node
        window = (half_s - abs(at - t)) / half_s**2
        total += float((weight * window * signal.at(at)).sum() * (b - a) / 2)
    return total


@pytest.mark.parametrize("seed", range(3))
def test_smoothed_pressure_advance_is_its_definition(seed: int) -> None:
    moves = trapezoids(chain(seed, 60), 0.04)
    moves["pressure_advance"][20:40] = 0.01
    moves["start"][:, 3] += 1000.0  # as late in a long print
    phases = Phases.of((0.0, 0.0, 0.0, float(moves["start"][0, 3])), moves)
    smoothed = Smoothed(phases.advanced(), 0.02)
    end = float(moves[-1]["print_time"])
    t = np.random.default_rng(seed).uniform(0.9, end + 0.3, 300)
    assert smoothed.at(t) == pytest.approx([by_quadrature(phases, 0.02, x) for x in t], abs=1e-10)
    h = 1e-5
    assert smoothed.slope(t) == pytest.approx((smoothed.at(t + h) - smoothed.at(t - h)) / (2 * h), abs=1e-2)


def test_shaping_is_a_sum_of_shifted_motions() -> None:
    phases = Phases.of(ORIGIN, trapezoids(chain(5, 30)))
    x = phases.mix((1.0, 0.0, 0.0, 0.0))
    shaped = Shaped(x, ((0.25, -0.01), (0.5, 0.0), (0.25, 0.01)))
    t = np.linspace(0.9, 3.0, 500)
    assert shaped.at(t) == pytest.approx(x.at(t) / 2 + (x.at(t + 0.01) + x.at(t - 0.01)) / 4, abs=1e-12)
    h = 1e-7
    assert shaped.slope(t) == pytest.approx((shaped.at(t + h) - shaped.at(t - h)) / (2 * h), abs=0.01)


@pytest.mark.parametrize("kind", list(PARAMS))
def test_slopes_of_the_kinematics_are_their_derivatives(kind: str) -> None:
    x, y, z = np.random.default_rng(7).uniform((-50, -50, 10), (50, 50, 60), (60, 3)).T
    gradient, h = INVERSE[kind](PARAMS[kind], x, y, z)[1], 1e-5
    for axis in range(3):
        step = [h * (i == axis) for i in range(3)]
        up = INVERSE[kind](PARAMS[kind], x + step[0], y + step[1], z + step[2])[0]
        down = INVERSE[kind](PARAMS[kind], x - step[0], y - step[1], z - step[2])[0]
        apart = up - down
        if kind == "polar_angle":
            apart = (apart + math.pi) % math.tau - math.pi
        assert gradient[axis] == pytest.approx(apart / (2 * h), rel=1e-5, abs=1e-8)


# ------------------------------------------------------------------------------------------ verdicts


def proof_of(moves: list[Move]) -> StepperProof:
    epochs: list[Epoch] = [(ORIGIN, trapezoids(moves))]
    return StepperProof([Leg(stepper(0, X), start, moved, Setting()) for start, moved in epochs])


@pytest.mark.parametrize("seed", range(3))
def test_good_steps_pass(seed: int) -> None:
    _, moves, streams = executed(seed)
    for spec in MACHINES["cartesian"]:
        proof = StepperProof([Leg(spec, ORIGIN, trapezoids(moves), Setting())])
        stream = streams[spec.name]
        verdict = check(proof, stream, NODES[spec.node].clock_freq, 12.5e-6)
        assert verdict.checked == verdict.emitted == stream.steps
        assert verdict.outside == 0
        assert verdict.position == verdict.wanted_position
        assert 0 <= verdict.wanted - verdict.emitted <= 2 * sum(m.cruise_v > 0 for m in moves)


def test_the_end_of_a_stretch_is_where_the_next_begins() -> None:
    moves, again = chain(1, 5), chain(2, 5)
    later = trapezoids(again)
    later["print_time"] += 100.0
    later["start"][:, 0] += 7.0
    epochs: list[Epoch] = [(ORIGIN, trapezoids(moves)), ((7.0, 0.0, 0.0, 0.0), later)]
    proof = StepperProof([Leg(stepper(0, X), start, moved, Setting()) for start, moved in epochs])
    first, second = proof_of(moves), proof_of(again)
    assert proof.wanted == pytest.approx(first.wanted + second.wanted, abs=1)
    assert proof.wanted_position == pytest.approx(first.wanted_position + second.wanted_position, abs=1)


def wrong(stream: Stream, what: str) -> Stream:
    middle = len(stream.count) // 2
    clock, direction, count = stream.clock.copy(), stream.direction.copy(), stream.count.copy()
    if what == "late":
        clock[middle] += round(14e-6 * FREQ)
    elif what == "early":
        clock[middle] -= round(14e-6 * FREQ)
    elif what == "backwards":
        direction[middle] *= -1
    else:
        count[middle] -= 1
    moved = direction * count
    return replace(stream, clock=clock, direction=direction, count=count, position=np.cumsum(moved) - moved)


@pytest.mark.parametrize("what", ["late", "early", "backwards", "lost"])
def test_bad_steps_are_found(what: str) -> None:
    _, moves, streams = executed(1)
    proof, stream = proof_of(moves), wrong(streams["s0"], what)
    verdict = check(proof, stream, FREQ, 12.5e-6)
    assert verdict.outside > 0
    assert (verdict.position != verdict.wanted_position) == (what in {"backwards", "lost"})
    t = verdict.outside_s
    assert check(proof, stream, FREQ, 12.5e-6, [(t - 0.1, t + 0.1)]).outside > 0
    assert check(proof, stream, FREQ, 12.5e-6, [(0.0, t - 0.1)]).outside == 0


@pytest.mark.parametrize("kind", [*LINEAR, *PARAMS])
@pytest.mark.parametrize("setting", [Setting(), SETTING], ids=["plain", "shaped"])
def test_every_crossing_is_counted_and_solved(kind: str, setting: Setting) -> None:
    moves = trapezoids(chain(9, 40), 0.05)
    moves["start"] += AWAY
    path = StepperPath(spec_of(kind), AWAY, moves, setting, 0)
    end = float(moves[-1]["print_time"]) + 0.5
    assert path.u(np.array([0.5]))[0] == pytest.approx(0, abs=1e-9)
    t: Floats = np.linspace(0.9, end, 200_001)
    place = np.floor(path.u(t) + 0.5).astype(np.int64)
    _, _, done = places(path)
    count, last = int(np.abs(np.diff(done)).sum()), int(done[-1])
    assert count == pytest.approx(int(np.abs(np.diff(place)).sum()), abs=4), "pairs between two samples"
    assert last == place[-1]
    at = np.flatnonzero(np.abs(np.diff(place)) == 1)
    assert len(at) > 100 or kind == "z"
    direction, boundary = np.diff(place)[at], (place[at] + place[at + 1]) / 2
    middle, reach = (t[at] + t[at + 1]) / 2, float(t[1] - t[0])
    found = solve(path, boundary, direction, middle, reach)
    assert (np.abs(found - middle) <= reach / 2 + 1e-9).all()
    assert path.u(found) == pytest.approx(boundary, abs=1e-6)
    assert np.isnan(solve(path, boundary[:1], -direction[:1], found[:1], 1e-6)).all()
    slope = (path.u(t[1:-1] + 1e-6) - path.u(t[1:-1] - 1e-6)) / 2e-6
    assert np.median(np.abs(path.slope(t[1:-1]) - slope)) < 0.01


@pytest.mark.parametrize(("beyond", "steps"), [(-2e-6, 20), (-5e-7, 20), (5e-7, 20), (2e-6, 21)])
def test_a_rest_at_a_boundary_is_no_step_unless_it_is_clearly_beyond(beyond: float, steps: int) -> None:
    moves = [make_move(1.0, ORIGIN, ((20.5 + beyond) * 0.00625, 0.0, 0.0, 0.0), (0.0, 20.0, 0.0), 1000.0)]
    run = Run([stepper(0, X)], [NODES[0]])
    batches = bytearray()
    assert run.gen.append(np.array([m.row() for m in moves]), 1) == 1
    assert run.gen.generate(9.0, flush=True)
    while batch := run.gen.take_batch(0):
        batches += batch
    stream = replay(bytes(batches), NODES[0], [stepper(0, X)])["s0"]
    verdict = check(proof_of(moves), stream, FREQ, 12.5e-6)
    assert (verdict.emitted, verdict.wanted, verdict.outside) == (steps, steps, 0)

"""Shaped, smoothed and non-linear steppers: every emitted step against positions evaluated by numpy alone."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from coordinator.config.options import BadValue
from coordinator.config.sections.extruder import SMOOTH_TIME
from coordinator.motion.specs import StepperSpec
from coordinator.motion.steps.errors import StepError
from coordinator.motion.steps.shapers import SHAPER_KINDS, shaper_impulses
from tests.coordinator.motion.steps_harness import MAX_ERROR_S, NOISE_S, Run, node_spec, rows, stepper
from tests.coordinator.motion.steps_oracle import LONG, Move, Position, make_move

Floats = NDArray[np.float64]
Impulses = Sequence[tuple[float, float]]
START: Position = (30.0, 10.0, 5.0, 0.0)
PLAIN: Impulses = ((1.0, 0.0),)
SMOOTH_S = 0.04
GRID_S = 1e-5
U_TOLERANCE = 1e-6
SMOOTH_TOLERANCE = 0.02
"""Steps: the grid that the smoothing is integrated on."""


class PressedMove(Move):
    """A move with pressure advance."""

    advance = 0.0

    def row(self) -> list[float]:
        return [*super().row()[:-2], self.advance, 0.0]


def square(advances: Sequence[float] = (0.0,) * 6) -> list[Move]:
    """Return a print-like path with rests, turns and a jump of speed at its corners."""
    corners: list[Position] = [
        START,
        (50.0, 10.0, 5.0, 0.8),
        (50.0, 40.0, 5.0, 2.0),
        (-20.0, -30.0, 6.0, 5.5),
        (-20.3, -30.1, 6.0, 5.52),
        (30.0, 12.0, 4.0, 8.0),
        (30.0, 12.0, 4.0, 7.0),
    ]
    moves: list[Move] = []
    time = 0.5
    for i, advance in enumerate(advances):
        speeds = (0.0 if i in {0, 5} else 3.0, 120.0, 0.0 if i >= 4 else 3.0)
        plain = make_move(time, corners[i], corners[i + 1], speeds, 3000.0)
        move = PressedMove(**{name: getattr(plain, name) for name in Move.__dataclass_fields__})
        object.__setattr__(move, "advance", advance)
        moves.append(move)
        time += move.total_s + (0.1 if i == 4 else 0.0)
    return moves


def planned(moves: Sequence[Move], times: Floats, axis: int, *, pressed: bool = False) -> Floats:
    """Return an axis as planned; PRESSED: with pressure advance, unsmoothed."""
    out = np.full(len(times), START[axis])
    for move in moves:
        at = times.astype(LONG) - LONG(move.print_time)
        inside = at >= 0
        way = move.way(at[inside])
        out[inside] = move.start[axis] + move.ratio[axis] * way.astype(np.float64)
        advance = getattr(move, "advance", 0.0)
        if pressed and advance:
            now = inside & (at < move.total_s)
            ahead = move.way(at[now] + LONG(1e-7)) - move.way(at[now] - LONG(1e-7))
            out[now] += (advance * move.ratio[axis] * ahead / LONG(2e-7)).astype(np.float64)
    return out


def shaped(moves: Sequence[Move], times: Floats, axis: int, impulses: Impulses) -> Floats:
    return sum((a * planned(moves, times - t, axis) for a, t in impulses), np.zeros(len(times)))


def smoothed(moves: Sequence[Move], times: Floats) -> Floats:
    grid = np.arange(-0.1, moves[-1].print_time + moves[-1].total_s + 1.0, GRID_S)
    half = round(SMOOTH_S / 2 / GRID_S)
    window = half - np.abs(np.arange(-half, half + 1)).astype(np.float64)
    values = np.convolve(planned(moves, grid, 3, pressed=True), window / window.sum(), "same")
    out: Floats = np.interp(times, grid[half:-half], values[half:-half])  # elsewhere the window has no values
    return out


def rotary(q: Sequence[float], x: Floats, y: Floats, z: Floats) -> Floats:
    """Solve the closure of the two links by bisection, above the elbow that stands outwards."""
    out, beside = q[4] * x + q[5] * y, q[4] * y - q[5] * x
    low, high = np.full(len(x), -1.5), np.full(len(x), 1.5)
    for _ in range(60):
        angle = (low + high) / 2
        gap = (q[2] + q[0] * np.cos(angle) - out) ** 2 + (q[3] + q[0] * np.sin(angle) - z) ** 2
        far = gap + beside**2 > q[1] ** 2
        low, high = np.where(far, low, angle), np.where(far, angle, high)
    return low


ROTARY = (80.0, 200.0, 60.0, 170.0, math.cos(0.4), math.sin(0.4))
KINEMATICS: dict[str, tuple[tuple[float, ...], float, Callable[..., Floats]]] = {
    "delta": (
        (250.0**2, 90.0, -50.0),
        0.0125,
        lambda x, y, z: z + np.sqrt(250.0**2 - (90 - x) ** 2 - (-50 - y) ** 2),
    ),
    "deltesian": (
        (200.0**2, -120.0),
        0.0125,
        lambda x, _y, z: z + np.sqrt(200.0**2 - (-120 - x) ** 2),
    ),
    "polar_radius": ((), 0.0125, lambda x, y, _z: np.hypot(x, y)),
    "polar_angle": ((), 0.0005, lambda x, y, _z: np.unwrap(np.arctan2(y, x))),
    "rotary_delta": (ROTARY, 0.0002, lambda x, y, z: rotary(ROTARY, x, y, z)),
    "winch": (
        (5.0, 20.0, -40.0),
        0.0125,
        lambda x, y, z: np.sqrt((x - 5) ** 2 + (y - 20) ** 2 + (z + 40) ** 2),
    ),
}


def check(run: Run, position: Callable[[Floats], Floats], distance: float, tolerance: float) -> None:
    """Every step straddles its boundary within the band, and no step is missing at the end."""
    freq = run.specs[0].clock_freq
    steps = run.steps(0)
    assert len(steps) > 100
    times = np.array([clock for clock, _ in steps]) / freq
    directions = np.array([d for _, d in steps])
    boundaries = np.cumsum(directions) - directions / 2
    slack = MAX_ERROR_S + NOISE_S
    begin = position(np.array([0.0, 0.1]))[0] / distance
    for side in (-1, 1):
        u = position(np.concatenate(([0.0], times + side * slack)))[1:] / distance - begin
        assert (side * directions * (u - boundaries) >= -tolerance).all()
    end = position(np.concatenate(([0.0], times, [1e3])))[-1] / distance - begin
    assert abs(directions.sum() - end) <= 0.5 + tolerance


def play(run: Run, moves: Sequence[Move], cuts: Sequence[tuple[float, bool]] = ()) -> None:
    end = moves[-1].print_time + moves[-1].total_s + run.gen.lag_s
    run.play(moves, [*cuts, (end, True)] if cuts else [(end, False), (end, True)])


@pytest.mark.parametrize("kind", SHAPER_KINDS)
@pytest.mark.parametrize("weights", [(1.0, 0.0, 0.0, 0.0), (1.0, -1.0, 0.0, 0.0)])
def test_shaped_linear(kind: str, weights: Position) -> None:
    moves, x, y = square(), shaper_impulses(kind, 45.0, 0.1), shaper_impulses("zv", 60.0, 0.05)
    run = Run([stepper(0, weights)], [node_spec()], start=START)
    run.gen.set_shaper(0, x)
    run.gen.set_shaper(1, y)
    play(run, moves)
    check(
        run,
        lambda t: weights[0] * shaped(moves, t, 0, x) + weights[1] * shaped(moves, t, 1, y),
        0.00625,
        1e-4,
    )


@pytest.mark.parametrize("advances", [(0.0,) * 6, (0.0, 0.05, 0.02, 0.08, 0.05, 0.0)])
def test_smoothed_pressure_advance(advances: Sequence[float]) -> None:
    moves = square(advances)
    run = Run([stepper(0, (0.0, 0.0, 0.0, 1.0), 0.0014)], [node_spec()], start=START)
    run.gen.set_smooth_time(0, SMOOTH_S)
    play(run, moves)
    check(run, lambda t: smoothed(moves, t), 0.0014, SMOOTH_TOLERANCE)


@pytest.mark.parametrize("kind", list(KINEMATICS))
@pytest.mark.parametrize("impulses", [PLAIN, shaper_impulses("ei", 50.0, 0.1)])
def test_kinematics(kind: str, impulses: Impulses) -> None:
    params, distance, formula = KINEMATICS[kind]
    moves = square()
    spec: StepperSpec = replace(stepper(0, (0.0,) * 4, distance), formula=kind, params=params)
    run = Run([spec], [node_spec()], start=START)
    for axis in range(3):
        run.gen.set_shaper(axis, impulses)
    play(run, moves)
    check(run, lambda t: formula(*(shaped(moves, t, i, impulses) for i in range(3))), distance, 1e-3)


def test_cuts_do_not_matter() -> None:
    impulses = shaper_impulses("mzv", 40.0, 0.1)
    streams = []
    for cuts in ([], [(0.61, False), (0.7, False), (1.1, False)]):
        run = Run([stepper(0, (1.0, 1.0, 0.0, 0.0))], [node_spec()], start=START)
        run.gen.set_shaper(0, impulses)
        play(run, square(), cuts)
        streams.append([d for _, d in run.steps(0)])
    assert streams[0] == streams[1]


def test_a_move_after_a_flush_begins_late_enough_to_leave_the_past_alone() -> None:
    impulses = shaper_impulses("mzv", 40.0, 0.1)
    run = Run(
        [stepper(0, (1.0, 0.0, 0.0, 0.0)), stepper(1, (0.0, 1.0, 0.0, 0.0))], [node_spec()], start=START
    )
    run.gen.set_shaper(0, impulses)
    first, last = square()[0], square()[1]
    assert run.gen.next_move_s == run.gen.look_ahead_s > 0
    run.play([first], [(first.print_time + first.total_s + run.gen.lag_s, True)])
    border = run.gen.next_move_s
    assert border == run.gen.generated_until + run.gen.look_ahead_s
    moves = [first, replace(last, print_time=border)]
    run.play(moves[1:], [(border + last.total_s + run.gen.lag_s, True)])
    check(run, lambda t: shaped(moves, t, 0, impulses), 0.00625, 1e-4)
    early = replace(first, print_time=run.gen.next_move_s - 0.001)
    with pytest.raises(StepError, match="the time lies before"):
        run.gen.append(rows([early]), 1)


def test_the_axes_of_a_delta_are_declared_elsewhere_without_a_step() -> None:
    params, distance, formula = KINEMATICS["delta"]
    spec = replace(stepper(0, (0.0,) * 4, distance), formula="delta", params=params)
    run = Run([spec], [node_spec()], start=(0.0, 0.0, 0.0, 0.0))
    run.gen.set_axis_position(START)
    play(run, square())
    check(run, lambda t: formula(*(planned(square(), t, i) for i in range(3))), distance, 1e-3)


def test_a_stepper_follows_another_axis_once_all_rests() -> None:
    run = Run([stepper(0, (1.0, 0.0, 0.0, 0.0))], [node_spec()], start=START)
    run.gen.set_shaper(0, shaper_impulses("zv", 40.0, 0.1))
    first, last = square()[0], square()[1]  # X alone, then Y alone
    run.play([first], [(first.print_time + first.total_s + run.gen.lag_s, True)])
    before = run.gen.position(0)
    run.gen.set_weights(0, (0.0, 1.0, 0.0, 0.0))
    assert run.gen.position(0) == before
    after = replace(last, print_time=run.gen.next_move_s)
    run.play([after], [(after.print_time + after.total_s + run.gen.lag_s, True)])
    assert run.gen.position(0) - before == round((last.end[1] - last.start[1]) / 0.00625)
    assert sum(d for _, d in run.steps(0)) == run.gen.position(0)


def test_nothing_changes_while_the_machine_moves() -> None:
    run = Run([stepper(0, (1.0, 0.0, 0.0, 1.0))], [node_spec()], start=START)
    run.gen.set_shaper(0, shaper_impulses("zv", 40.0, 0.1))
    run.play(square())
    refused = "cannot change while steps of earlier moves may come"
    with pytest.raises(StepError, match=refused):
        run.gen.set_shaper(0, ())
    with pytest.raises(StepError, match=refused):
        run.gen.set_smooth_time(0, 0.02)
    with pytest.raises(StepError, match=refused):
        run.gen.set_weights(0, (0.0, 0.0, 0.0, 0.0))


def test_a_configuration_has_no_smooth_time_that_step_generation_refuses() -> None:
    """Failed before: 0.05 ms was loaded, and then no start succeeded."""
    run = Run([stepper(0, (1.0, 0.0, 0.0, 1.0))], [node_spec()])
    for text in ("0.0001", "0.2"):
        run.gen.set_smooth_time(0, SMOOTH_TIME.parse(text))
    for text in ("0.00005", "0.000099", "0.201"):
        with pytest.raises(BadValue):
            SMOOTH_TIME.parse(text)
        with pytest.raises(StepError, match="out of range"):
            run.gen.set_smooth_time(0, float(text))


def test_a_bad_shaper_is_refused() -> None:
    run = Run([stepper(0, (1.0, 0.0, 0.0, 0.0))], [node_spec()])
    with pytest.raises(StepError, match="out of range"):
        run.gen.set_shaper(0, [(0.5, -0.01), (0.4, 0.01)])


def test_a_stepper_without_a_position_at_the_start_is_refused() -> None:
    spec = replace(stepper(0, (0.0,) * 4), formula="delta", params=(10.0**2, 90.0, -50.0))
    with pytest.raises(StepError, match="no position with the axes at"):
        Run([spec], [node_spec()])


def test_a_formula_that_was_not_compiled_is_refused() -> None:
    with pytest.raises(StepError, match="have no formula 'scara'; add it by STEP_FORMULA"):
        Run([replace(stepper(0, (0.0,) * 4), formula="scara")], [node_spec()])

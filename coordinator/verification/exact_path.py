"""An independent evaluation of every stepper's motion, and of every step that was emitted.

``StepperPath`` is a stepper's place u (steps) as a function of print time, from trapezoids, shapers,
pressure advance and the inverse formulas of the kinematics. ``solve`` finds when u crosses the boundary of a
step; ``turning_points`` cuts u into monotone pieces, so that ``places`` counts all steps there must be.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from coordinator.motion.specs import StepperSpec
from coordinator.verification.exact_bed import ExactBed
from coordinator.verification.exact_signal import REST_S, Floats, Phases, Shaped, Signal, Smoothed
from coordinator.verification.half_steps import all_settled

Ints = NDArray[np.int64]
Impulses = tuple[tuple[float, float], ...]
"""(amplitude, delay in s) of each."""
Position = tuple[float, float, float, float]
AxisSignal = Signal | Shaped | Smoothed
UNSHAPED: Impulses = ((1.0, 0.0),)
PARTS_OF_PATCH = 8
"""A piece over a bed is looked at in so many parts of a patch's width, and in so many at least."""
FORMULAS_WITH_Z = ("delta", "deltesian", "winch", "rotary_delta")
PIECES = 1 << 16
"""Looked at together: bounds the memory that long programs take."""
SAMPLES = 7
"""Of the slope, per piece: a cubic has at most two turns inside."""
HALVINGS = 60
GRID = 64


@dataclass(frozen=True)
class Setting:
    """What acts on the axes between trapezoids and steppers."""

    shapers: Mapping[str, Impulses] = field(default_factory=dict)
    """By axis letter (X, Y, Z)."""
    smooth_s: float = 0.0
    """Full width of the window of pressure advance; 0: none."""
    bed: ExactBed | None = None
    """The shape of the bed that Z follows."""

    def acts_on(self, weights: Position) -> bool:
        """Return whether a linear stepper of these WEIGHTS moves otherwise than its axes."""
        shaped = any(weights["XYZ".index(axis)] for axis in self.shapers)
        return bool(shaped or (self.smooth_s and weights[3]) or (self.bed is not None and weights[2]))


# ---------------------------------------------------------------------------------------- kinematics


Gradient = tuple[Floats, Floats, Floats]
Inverse = Callable[[Sequence[float], Floats, Floats, Floats], tuple[Floats, Gradient]]
"""(params, x, y, z) -> the stepper's place, and its change with each of the three."""


def _delta(params: Sequence[float], x: Floats, y: Floats, z: Floats) -> tuple[Floats, Gradient]:
    arm2, tx, ty = params[:3]
    dx, dy = tx - x, ty - y
    rise = np.sqrt(arm2 - dx * dx - dy * dy)
    return z + rise, (dx / rise, dy / rise, np.ones_like(z))


def _deltesian(params: Sequence[float], x: Floats, y: Floats, z: Floats) -> tuple[Floats, Gradient]:
    arm2, ax = params[:2]
    dx = ax - x
    rise = np.sqrt(arm2 - dx * dx)
    return z + rise, (dx / rise, np.zeros_like(y), np.ones_like(z))


def _radius(_params: Sequence[float], x: Floats, y: Floats, z: Floats) -> tuple[Floats, Gradient]:
    r = np.hypot(x, y)
    return r, (x / r, y / r, np.zeros_like(z))


def _angle(_params: Sequence[float], x: Floats, y: Floats, z: Floats) -> tuple[Floats, Gradient]:
    rr = x * x + y * y
    return np.arctan2(y, x), (-y / rr, x / rr, np.zeros_like(z))


def _winch(params: Sequence[float], x: Floats, y: Floats, z: Floats) -> tuple[Floats, Gradient]:
    dx, dy, dz = x - params[0], y - params[1], z - params[2]
    d = np.sqrt(dx * dx + dy * dy + dz * dz)
    return d, (dx / d, dy / d, dz / d)


def _rotary_delta(params: Sequence[float], x: Floats, y: Floats, z: Floats) -> tuple[Floats, Gradient]:
    upper, lower, radius, height, cos, sin = params[:6]
    outward, lateral = x * cos + y * sin, y * cos - x * sin
    a, b = radius - outward, height - z
    k = (lower**2 - lateral**2 - upper**2 - a * a - b * b) / (2 * upper)
    theta = np.arctan2(b, a) - np.arccos(k / np.hypot(a, b))
    # a·cos θ + b·sin θ = k: differentiate both sides by each coordinate.
    turn = b * np.cos(theta) - a * np.sin(theta)
    by_outward = (a / upper + np.cos(theta)) / turn
    by_lateral = -lateral / upper / turn
    by_z = (b / upper + np.sin(theta)) / turn
    return theta, (by_outward * cos - by_lateral * sin, by_outward * sin + by_lateral * cos, by_z)


INVERSE: Mapping[str, Inverse] = {
    "delta": _delta,
    "deltesian": _deltesian,
    "polar_radius": _radius,
    "polar_angle": _angle,
    "winch": _winch,
    "rotary_delta": _rotary_delta,
}
"""By formula (coordinator/kinematics/*.c); the definitions again, for arrays."""


# ---------------------------------------------------------------------------------------------- paths


class StepperPath:
    """One stepper's place in steps, over an interval of print time without a declaration."""

    def __init__(
        self, spec: StepperSpec, start: Position, moves: NDArray[np.void], setting: Setting, position: float
    ) -> None:
        """POSITION: where the stepper stands at START, in steps."""
        self.spec = spec
        phases = Phases.of(start, moves)
        by_bed = setting.bed is not None and (spec.formula in FORMULAS_WITH_Z or spec.weights[2] != 0)
        self._bed = setting.bed if by_bed else None
        self._by_axes = spec.formula is not None or self._bed is not None
        if not self._by_axes:
            self._axes: list[AxisSignal] = _linear(spec.weights, phases, setting)
        else:
            self._axes = [_axis(axis, 1.0, phases, setting) for axis in range(3)]
        self.curved = self._by_axes or any(not isinstance(axis, Signal) for axis in self._axes)
        """Not one straight move after the other: then the end of a move is no rest."""
        self._origin = 0.0
        self._origin = float(self.u(np.array([REST_S]))[0]) - position

    def u(self, t: Floats, near: Floats | None = None) -> Floats:
        """Return the place at T; of an angle the turn that is next to NEAR (steps)."""
        at = [axis.at(t) for axis in self._axes]
        if self._bed is not None:
            at[2] = self._bed.motor_z(*at)
        if not self._by_axes:
            place: Floats = sum(at[1:], at[0])
        else:
            place = self._inverse(at)[0]
        u = place / self.spec.step_distance - self._origin
        if near is not None and self.spec.formula == "polar_angle":
            turn = math.tau / self.spec.step_distance
            u += turn * np.round((near - u) / turn)
        return u

    def slope(self, t: Floats) -> Floats:
        """Return du/dt, steps/s."""
        speed = [axis.slope(t) for axis in self._axes]
        if not self._by_axes:
            rate: Floats = sum(speed[1:], speed[0])
        else:
            at = [axis.at(t) for axis in self._axes]
            if self._bed is not None:
                speed[2] = self._bed.motor_speed(at, speed)
                at[2] = self._bed.motor_z(*at)
            gradient = self._inverse(at)[1]
            rate = sum((g * v for g, v in zip(gradient, speed, strict=True)), np.zeros_like(t))
        return rate / self.spec.step_distance

    def breaks(self) -> Floats:
        """Return the times between which u is smooth, rising."""
        breaks = np.unique(np.concatenate([axis.breaks() for axis in self._axes]))
        if self._bed is None:
            return breaks
        # Over a bed's patches u turns where nothing of the plan does: few turns lie within a part of a patch.
        passed = self._bed.patches_passed(self._axes[0].at(breaks), self._axes[1].at(breaks))
        parts = np.maximum(np.ceil(passed * PARTS_OF_PATCH), PARTS_OF_PATCH).astype(int)
        pieces = [
            np.linspace(begin, end, count, endpoint=False)
            for begin, end, count in zip(breaks[:-1], breaks[1:], parts, strict=True)
        ]
        return np.concatenate((*pieces, breaks[-1:]))

    def _inverse(self, at: Sequence[Floats]) -> tuple[Floats, Gradient]:
        if self.spec.formula is not None:
            return INVERSE[self.spec.formula](self.spec.params, *at)
        weights = self.spec.weights[:3]
        place: Floats = sum((w * x for w, x in zip(weights, at, strict=True)), np.zeros_like(at[0]))
        x, y, z = (np.full_like(at[0], weight) for weight in weights)
        return place, (x, y, z)


def _linear(weights: Position, phases: Phases, setting: Setting) -> list[AxisSignal]:
    """Return signals whose sum is the weighted sum of the axes: equal shapers share one."""
    by_shaper: dict[Impulses, list[float]] = {}
    for i, letter in enumerate("XYZ"):
        if weights[i]:
            mix = by_shaper.setdefault(setting.shapers.get(letter, UNSHAPED), [0.0] * 4)
            mix[i] = weights[i]
    axes: list[AxisSignal] = []
    if weights[3]:
        axes.append(_axis(3, weights[3], phases, setting))
    for impulses, mix in by_shaper.items():
        signal = phases.mix(mix)
        axes.append(signal if impulses == UNSHAPED else Shaped(signal, impulses))
    return axes or [phases.mix((0.0, 0.0, 0.0, 0.0))]


def _axis(axis: int, weight: float, phases: Phases, setting: Setting) -> AxisSignal:
    weights = [weight if i == axis else 0.0 for i in range(4)]
    signal = phases.mix(weights)
    if axis == 3:
        if not setting.smooth_s:
            return signal
        return Smoothed(phases.advanced().scaled(weight), setting.smooth_s / 2)
    impulses = setting.shapers.get("XYZ"[axis], UNSHAPED)
    return signal if impulses == UNSHAPED else Shaped(signal, impulses)


# -------------------------------------------------------------------------------------------- solving


def solve(path: StepperPath, boundary: Floats, direction: Ints, near: Floats, reach_s: float) -> Floats:
    """Return when u crosses BOUNDARY in DIRECTION, each within REACH_S of NEAR (s); NaN where it does not.

    Of several crossings the nearest, as far as they are GRID-ths of REACH_S apart.
    """
    found = crossing_times(path, boundary, direction, near - reach_s, near + reach_s)
    # Where it turns just behind the step (or just before), the ends of the reach lie on the same side.
    for i in np.flatnonzero(np.isnan(found)):
        at = near[i] + reach_s * np.linspace(-1, 1, 2 * GRID + 1)
        b = np.full(len(at), boundary[i])
        ahead = direction[i] * (path.u(at, b) - b)
        cells = np.flatnonzero((ahead[:-1] <= 0) & (ahead[1:] >= 0))
        if len(cells):
            cell = cells[np.argmin(np.abs(at[cells] - near[i]))]
            one = slice(cell, cell + 1)
            found[i] = crossing_times(path, b[one], direction[i : i + 1], at[one], at[cell + 1 : cell + 2])[0]
    return found


def crossing_times(path: StepperPath, boundary: Floats, direction: Ints, low: Floats, high: Floats) -> Floats:
    """Return when u crosses BOUNDARY between LOW and HIGH; NaN where it is not behind it and then beyond."""

    def ahead(t: Floats, which: Ints) -> Floats:
        return direction[which] * (path.u(t, boundary[which]) - boundary[which])

    every = np.arange(len(boundary))
    f_low, f_high = ahead(low, every), ahead(high, every)
    found = np.full(len(boundary), np.nan)
    live: Ints = np.flatnonzero((f_low <= 0) & (f_high >= 0))
    low, high, f_low, f_high = low[live], high[live], f_low[live], f_high[live]
    for trial in range(HALVINGS):
        # The secant, and every third time the middle: never slower than a third of bisection.
        middle = (low + high) / 2
        if trial % 3 < 2:
            way = f_high - f_low
            secant = low - f_low * (high - low) / np.where(way > 0, way, 1.0)
            middle = np.where(way > 0, np.clip(secant, low, high), middle)
        f = ahead(middle, live)
        before = f < 0
        low, f_low = np.where(before, middle, low), np.where(before, f, f_low)
        high, f_high = np.where(before, high, middle), np.where(before, f_high, f)
        done = (np.abs(f) < 1e-9) | (high - low < 1e-12)
        found[live[done]] = np.where(np.abs(f) < 1e-9, middle, (low + high) / 2)[done]
        go = ~done
        live = live[go]
        low, high, f_low, f_high = low[go], high[go], f_low[go], f_high[go]
        if not len(live):
            break
    found[live] = (low + high) / 2
    return found


def turning_points(path: StepperPath) -> Floats:
    """Return times between which u is monotone, rising: breaks, and where the slope changes its sign."""
    breaks = path.breaks()
    turns = [
        _turns(path, breaks[at : at + PIECES], breaks[at + 1 : at + PIECES + 1])
        for at in range(0, len(breaks) - 1, PIECES)
    ]
    return np.unique(np.concatenate((breaks, *turns)))


def _turns(path: StepperPath, begin: Floats, end: Floats) -> Floats:
    """Return where the slope changes its sign within the pieces from BEGIN to END."""
    begin = begin[: len(end)]
    # From just inside one end to just inside the other: at a break itself the slope may jump.
    share = np.linspace(1e-6, 1 - 1e-6, SAMPLES)
    at = begin[:, None] + (end - begin)[:, None] * share
    slope = path.slope(at.reshape(-1)).reshape(at.shape)
    signs = np.sign(slope)
    for i in range(1, SAMPLES):  # a sample may hit the turn: in a symmetric piece the middle one does
        signs[:, i] = np.where(signs[:, i] == 0, signs[:, i - 1], signs[:, i])
    row, column = np.nonzero(signs[:, :-1] * signs[:, 1:] < 0)
    low, high, sign = at[row, column], at[row, column + 1], signs[row, column]
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        before = path.slope(middle) * sign > 0
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    return low


def places(path: StepperPath, standing: int = 0) -> tuple[Floats, Floats, Ints]:
    """Return the turning points (s), u there, and how many steps are done at each.

    STANDING: the step at which the stepper stands before.
    """
    t = turning_points(path)
    u = path.u(t)
    if path.spec.formula == "polar_angle":
        u = np.unwrap(u, period=math.tau / path.spec.step_distance)
    return t, u, all_settled(u, standing)


@dataclass(frozen=True)
class Leg:
    """A stretch of moves over which the same acts on a stepper."""

    spec: StepperSpec
    start: Position
    """Where the axes stand before the first move."""
    moves: NDArray[np.void]
    setting: Setting
    declared: bool = True
    """START is a new name for where the stepper stands; else it came there and keeps its share of a step."""

    @property
    def is_plain(self) -> bool:
        """Whether the stepper moves as the axes do."""
        return self.spec.formula is None and not self.setting.acts_on(self.spec.weights)


def follow(legs: Iterable[Leg]) -> Iterator[tuple[StepperPath, Floats, Floats, Ints]]:
    """Yield the path of each leg with its ``places``."""
    at, standing = 0.0, 0
    for leg in legs:
        path = StepperPath(leg.spec, leg.start, leg.moves, leg.setting, standing if leg.declared else at)
        t, u, place = places(path, standing)
        yield path, t, u, place
        at, standing = float(u[-1]), int(place[-1])

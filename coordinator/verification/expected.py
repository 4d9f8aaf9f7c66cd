"""When each stepper has to step, straight from the plan: the demo's independent witness.

This is numpy over the planner's trapezoids and shares nothing with the C step generator that it checks. It is
slower and needs more memory than that one, and is meant to be read and believed.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coordinator.verification.half_steps import all_settled

_CHUNK = 4096
"""Trapezoids looked at together: bounds the memory of long programs."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class ExpectedSteps:
    """Some successive steps of one stepper: print times in s, directions +1 or -1."""

    print_time: Floats
    direction: NDArray[np.int8]


@dataclass(frozen=True, slots=True)
class _Phases:
    """The constant-acceleration phases of some trapezoids, in steps of one stepper, as equal arrays."""

    begin: Floats
    """s, print time."""
    duration: Floats
    position: Floats
    """Steps from the origin, at the begin."""
    end: Floats
    velocity: Floats
    """Steps/s at the begin."""
    acceleration: Floats


def _phases(moves: NDArray[np.void], weights: Floats, step_distance: float, origin: float) -> _Phases:
    scale = (moves["ratio"] @ weights) / step_distance
    start = (moves["start"] @ weights - origin) / step_distance
    accel_s, cruise_s, decel_s = moves["accel_s"], moves["cruise_s"], moves["decel_s"]
    start_v, cruise_v, accel = moves["start_v"], moves["cruise_v"], moves["accel"]
    zero = np.zeros_like(accel)
    way = np.cumsum(
        [
            zero,
            start_v * accel_s + accel * accel_s**2 / 2,
            cruise_v * cruise_s,
            cruise_v * decel_s - accel * decel_s**2 / 2,
        ],
        axis=0,
    )
    position = start + scale * way
    duration = np.array([accel_s, cruise_s, decel_s])
    begin = moves["print_time"] + np.cumsum([zero, accel_s, cruise_s], axis=0)

    def in_order(rows: NDArray[np.float64]) -> Floats:
        return np.ascontiguousarray(rows.T).ravel()

    return _Phases(
        begin=in_order(begin),
        duration=in_order(duration),
        position=in_order(position[:3]),
        end=in_order(position[1:]),
        velocity=in_order(scale * np.array([start_v, cruise_v, cruise_v])),
        acceleration=in_order(scale * np.array([accel, zero, -accel])),
    )


def _crossings(phases: _Phases, before: Ints, after: Ints) -> ExpectedSteps:
    """Return the times at which each phase crosses the half-step boundaries between BEFORE and AFTER."""
    count = np.abs(after - before).astype(np.intp)  # on 32 bits, repeat() takes no longer numbers
    which = np.repeat(np.arange(len(count)), count)
    nth = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    direction = np.sign(after - before)[which]
    boundary = before[which] + direction * (nth + 0.5)
    # A boundary that the phase before passed by less than decides a tie is due at once.
    way = direction * np.maximum(direction * (boundary - phases.position[which]), 0)
    v, a = phases.velocity[which], phases.acceleration[which]
    # The root of way = v·t + a·t²/2 in the form that does not cancel when a is small or zero.
    root = np.sqrt(np.maximum(v * v + 2 * a * way, 0))
    speed = v + direction * root
    t = np.divide(2 * way, speed, out=np.zeros_like(way), where=speed != 0)
    t = np.clip(t, 0, phases.duration[which])
    return ExpectedSteps(phases.begin[which] + t, direction.astype(np.int8))


def expected_steps(
    moves: NDArray[np.void],
    weights: tuple[float, float, float, float],
    step_distance: float,
    origin: float,
) -> Iterator[ExpectedSteps]:
    """Yield the steps that MOVES (struct trapezoid, in order) ask of one stepper.

    A stepper stands at step round((position - ORIGIN) / STEP_DISTANCE), position being the weighted sum of
    the axes in mm; it steps when its position crosses the middle between two steps. Where a phase ends at the
    middle, it stays where it came from (``half_steps``).
    """
    weight = np.array(weights)
    standing: int | None = None
    for at in range(0, len(moves), _CHUNK):
        phases = _phases(moves[at : at + _CHUNK], weight, step_distance, origin)
        if standing is None:
            standing = int(np.floor(phases.position[0] + 0.5))
        after = all_settled(phases.end, standing)
        # A phase begins where the one before it ended, whatever the last bit of its own start says.
        before = np.concatenate(([standing], after[:-1]))
        standing = int(after[-1])
        yield _crossings(phases, before, after)

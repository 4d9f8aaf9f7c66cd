"""Motions, settings and steppers of every kinematics, for tests of the proof and of the engine."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from coordinator.motion.specs import StepperSpec
from coordinator.verification.exact_path import Setting
from coordinator.verification.exact_signal import TRAPEZOID
from tests.coordinator.motion.steps_harness import ORIGIN, X, stepper
from tests.coordinator.motion.steps_oracle import Move, Position, make_move

PARAMS = {
    "delta": (250.0**2, 100.0, -60.0),
    "deltesian": (200.0**2, -110.0),
    "polar_radius": (),
    "polar_angle": (),
    "winch": (-300.0, 500.0, 900.0),
    "rotary_delta": (120.0, 300.0, 60.0, 250.0, math.cos(2.0), math.sin(2.0)),
}


SHAPER = ((0.2, -0.006), (0.5, -0.001), (0.3, 0.017 / 3))
SETTING = Setting({"X": SHAPER, "Y": ((0.5, -0.004), (0.5, 0.004))}, 0.04)
AWAY: Position = (40.0, 30.0, 20.0, 0.0)
LINEAR = {
    "x": X,
    "corexy": (1.0, -1.0, 0.0, 0.0),
    "extruder": (0.0, 0.0, 0.0, 1.0),
    "z": (0.0, 0.0, 1.0, 0.0),
}


def spec_of(kind: str) -> StepperSpec:
    if kind in LINEAR:
        return stepper(0, LINEAR[kind], 0.002 if kind == "extruder" else 0.00625)
    rad = kind in {"polar_angle", "rotary_delta"}
    return replace(stepper(0, X, 1e-4 if rad else 0.00625), formula=kind, params=PARAMS[kind])


def chain(seed: int, count: int) -> list[Move]:
    """Return random moves in a row, with rests now and then."""
    rng = np.random.default_rng(seed)
    moves: list[Move] = []
    t, at, joint = 1.0, ORIGIN, 0.0
    for _ in range(count):
        dx, dy, de = rng.normal(0, 1.5, 3)
        end: Position = (at[0] + dx, at[1] + dy, 0.0, at[3] + abs(de) * 0.05)
        top = float(rng.uniform(20, 200))
        moves.append(make_move(t, at, end, (joint, top, float(rng.choice([0.0, 8.0, top]))), 4000.0))
        last = moves[-1]
        joint = max(last.cruise_v - last.accel * last.seconds[2], 0.0)
        t, at = t + last.total_s, end
        if rng.random() < 0.1:
            t, joint = t + 0.3, 0.0
    return moves


def trapezoids(moves: list[Move], advance: float = 0.0) -> NDArray[np.void]:
    rows = np.array([m.row() for m in moves])
    assert rows.dtype.itemsize * rows.shape[1] == TRAPEZOID.itemsize
    found = np.frombuffer(rows.tobytes(), TRAPEZOID).copy()
    found["pressure_advance"] = advance
    return found

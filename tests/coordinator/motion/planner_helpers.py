"""What the planner's tests share: a machine, ways to run text through it, what must hold of any output."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from coordinator.motion.planner.planner import FeedStatus, Planner
from coordinator.motion.specs import MotionLimits
from coordinator.motion.trapezoid_array import TRAPEZOID, array_of

GCODE = Path(__file__).parents[3] / ".." / "shared" / "data" / "gcode"
LIMITS = MotionLimits(
    max_velocity=400,
    max_accel=10000,
    max_z_velocity=15,
    max_z_accel=500,
    square_corner_velocity=8,
    minimum_cruise_ratio=0.5,
    position_min=(0, 0, 0),
    position_max=(250, 250, 250),
    max_extrude_only_velocity=120,
    max_extrude_only_accel=3000,
    max_extrude_only_distance=50,
    max_extrude_ratio=2.08,
    instantaneous_corner_velocity=1,
)
Array = npt.NDArray[np.void]


def real_file(name: str) -> bytes:
    """The bytes of a sliced file, or skip."""
    path = GCODE / name
    if not path.exists():
        pytest.skip(f"{name} is not beside the project")
    return path.read_bytes()


def homed_planner(limits: MotionLimits = LIMITS) -> Planner:
    planner = Planner(limits)
    planner.homed = "XYZ"
    return planner


def drain(planner: Planner) -> list[Array]:
    """Take and release everything that waits."""
    pieces = []
    while (batch := planner.take()).count:
        pieces.append(array_of(batch).copy())
        planner.release(batch.count)
    return pieces


def flushed(planner: Planner) -> list[Array]:
    pieces = []
    while not planner.flush():
        pieces += drain(planner)
    return pieces + drain(planner)


def joined(pieces: list[Array]) -> Array:
    return np.concatenate(pieces) if pieces else np.empty(0, TRAPEZOID)


def planned(planner: Planner, text: bytes, chunk: int = 1 << 20) -> Array:
    """Feed TEXT (G0/G1 lines only) in pieces of CHUNK bytes, to the end."""
    pieces, start, end = [], 0, 0
    while True:
        end = min(len(text), max(end, start + chunk))
        feed = planner.feed(text, start, end, final=end == len(text))
        start = feed.offset
        pieces += drain(planner)
        if feed.status is FeedStatus.NEED_DATA:
            if end == len(text):
                return joined(pieces + flushed(planner))
            end += chunk
        else:
            assert feed.status is FeedStatus.FULL, (feed, planner.fault)


def end_speeds(t: Array) -> npt.NDArray[np.float64]:
    return np.asarray(t["cruise_v"] - t["accel"] * t["decel_s"])


def lengths(t: Array) -> npt.NDArray[np.float64]:
    """Way of each trapezoid by integrating its phases."""
    v, a = t["cruise_v"], t["accel"]
    way = (t["start_v"] * t["accel_s"] + a * t["accel_s"] ** 2 / 2) + v * t["cruise_s"]
    return np.asarray(way + v * t["decel_s"] - a * t["decel_s"] ** 2 / 2)


def check_invariants(
    t: Array, limits: MotionLimits = LIMITS, *, end: tuple[float, ...] | None = None
) -> None:
    """Everything that must hold of consecutive trapezoids from standstill to standstill."""
    if len(t) == 0:
        return
    for name in TRAPEZOID.names or ():
        assert np.isfinite(t[name]).all(), name
    for name in ("accel_s", "cruise_s", "decel_s", "start_v"):
        assert (t[name] >= 0).all(), name
    assert (t["accel"] > 0).all()

    total = t["accel_s"] + t["cruise_s"] + t["decel_s"]
    assert (total > 0).all()
    assert (t["print_time"][1:] == t["print_time"][:-1] + total[:-1]).all(), "print time has gaps"

    assert t["start_v"][0] == 0
    ends = end_speeds(t)
    # v = √v² at both sides; the speeds differ by rounding, which is absolute in terms of the highest speed.
    np.testing.assert_allclose(ends[:-1], t["start_v"][1:], rtol=1e-9, atol=1e-9)
    assert abs(ends[-1]) < 1e-9
    np.testing.assert_allclose(t["start_v"] + t["accel"] * t["accel_s"], t["cruise_v"], rtol=1e-9, atol=1e-9)

    where = t["start"] + t["ratio"] * lengths(t)[:, None]
    np.testing.assert_allclose(where[:-1], t["start"][1:], rtol=0, atol=1e-9)
    if end is not None:
        np.testing.assert_allclose(where[-1], end, rtol=0, atol=1e-8)
    check_limits(t, limits)


def check_limits(t: Array, limits: MotionLimits) -> None:
    near = 1 + 1e-9
    ratio = np.abs(t["ratio"])
    path = np.linalg.norm(t["ratio"][:, :3], axis=1)
    alone = (ratio[:, :3] == 0).all(axis=1)
    np.testing.assert_allclose(np.where(alone, ratio[:, 3], path), 1, rtol=1e-12)
    assert (t["cruise_v"] <= limits.max_velocity * near).all()
    assert (t["accel"] <= limits.max_accel * near).all()
    assert (t["cruise_v"] * ratio[:, 2] <= limits.max_z_velocity * near).all()
    assert (t["accel"] * ratio[:, 2] <= limits.max_z_accel * near).all()
    squeezed = alone | (t["ratio"][:, 3] < 0)
    assert (t["cruise_v"] * ratio[:, 3])[squeezed].max(initial=0) <= limits.max_extrude_only_velocity * near
    assert (t["accel"] * ratio[:, 3])[squeezed].max(initial=0) <= limits.max_extrude_only_accel * near
    where = t["start"] + t["ratio"] * lengths(t)[:, None]
    for axis in range(3):
        moves = ratio[:, axis] > 0
        inside = where[moves, axis]
        assert (inside >= limits.position_min[axis] - 1e-8).all()
        assert (inside <= limits.position_max[axis] + 1e-8).all()

"""Random machines of every kinematics, with points of their work spaces."""

import math
from collections.abc import Mapping

from hypothesis import assume
from hypothesis import strategies as st

from coordinator.kinematics import delta, deltesian, rotary_delta
from coordinator.kinematics.base import Kinematics, Point, WorkSpace
from coordinator.kinematics.cartesian import Cartesian
from coordinator.kinematics.corexy import CoreXY
from coordinator.kinematics.corexz import CoreXZ
from coordinator.kinematics.generic_cartesian import GenericCartesian
from coordinator.kinematics.hybrid_corexy import HybridCoreXY
from coordinator.kinematics.hybrid_corexz import HybridCoreXZ
from coordinator.kinematics.polar import Polar
from coordinator.kinematics.winch import Winch

BOX = WorkSpace((-50.0, 0.0, -2.0), (300.0, 250.0, 400.0))
Draw = st.DrawFn


def number(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False)


@st.composite
def deltas(draw: Draw) -> Kinematics:
    radius = draw(number(50, 200))
    rod = radius * draw(number(1.6, 3))
    towers = [
        delta.Tower(
            math.radians(angle + draw(number(-5, 5))), rod + draw(number(-3, 3)), 300 + draw(number(-3, 3))
        )
        for angle in (210, 330, 90)
    ]
    return delta.Delta((towers[0], towers[1], towers[2]), radius)


@st.composite
def deltesians(draw: Draw) -> Kinematics:
    reach = draw(number(100, 200))
    arms = [
        deltesian.Arm(side * (reach + draw(number(-5, 5))), reach * draw(number(1.3, 2.5)), 250)
        for side in (-1, 1)
    ]
    return deltesian.Deltesian(arms[0], arms[1], (-20, 200))


@st.composite
def rotary_deltas(draw: Draw) -> Kinematics:
    upper = draw(number(120, 180))
    lower = upper * draw(number(1.8, 2.2))
    height = upper * draw(number(2, 2.3))
    arms = [
        rotary_delta.Arm(upper, lower + draw(number(-1, 1)), math.radians(angle)) for angle in (30, 150, 270)
    ]
    radius = draw(number(20, 40))
    end = draw(number(0, 0.5))  # rad, where the endstops are
    outward = radius + upper * math.cos(end)
    top = height + upper * math.sin(end) - math.sqrt(lower**2 - outward**2)
    return rotary_delta.RotaryDelta(
        (arms[0], arms[1], arms[2]),
        shoulder_radius=radius,
        shoulder_height=height,
        endstop_height=(top, top - 1, top + 1),
    )


@st.composite
def winches(draw: Draw) -> Kinematics:
    corners = [
        (0.0, -2000.0, -100.0),
        (2000.0, 1000.0, -100.0),
        (-2000.0, 1000.0, -100.0),
        (0.0, 0.0, 3000.0),
    ]
    hanging = [(x, y, 2500.0 + draw(number(0, 100))) for x, y, _ in corners[:3]]
    moved = draw(st.sampled_from([corners, hanging]))
    if moved is hanging:
        moved = [*hanging, (0.0, 0.0, 2500.0), (0.0, 0.0, 0.0)][: draw(st.integers(3, 5))]
    return Winch(tuple((x + draw(number(-50, 50)), y + draw(number(-50, 50)), z) for x, y, z in moved))


@st.composite
def generic(draw: Draw) -> Kinematics:
    weight = st.sampled_from([-2.0, -1.0, -0.5, 0.0, 0.25, 1.0, 3.0])
    rows = draw(st.lists(st.tuples(weight, weight, weight), min_size=3, max_size=5))
    machine = GenericCartesian(tuple((f"m{i}", row) for i, row in enumerate(rows)), BOX)
    assume(machine.independent)
    return machine


def polars() -> st.SearchStrategy[Kinematics]:
    return st.builds(lambda inner: Polar((inner, 150.0), (0.0, 200.0)), st.sampled_from([-1.0, 0.0, 5.0]))


MACHINES: Mapping[str, st.SearchStrategy[Kinematics]] = {
    "cartesian": st.just(Cartesian(BOX)),
    "corexy": st.just(CoreXY(BOX)),
    "corexz": st.just(CoreXZ(BOX)),
    "hybrid_corexy": st.just(HybridCoreXY(BOX)),
    "hybrid_corexz": st.just(HybridCoreXZ(BOX)),
    "generic_cartesian": generic(),
    "delta": deltas(),
    "deltesian": deltesians(),
    "polar": polars(),
    "rotary_delta": rotary_deltas(),
    "winch": winches(),
}
"""By the kinematics' name."""


def ceiling(space: WorkSpace, x: float, y: float) -> float:
    """How high the head may be at X and Y."""
    down = math.hypot(space.cone_slope[0] * x, space.cone_slope[1] * y)
    return max(space.high[2], space.cone_top - down) if any(space.cone_slope) else space.high[2]


@st.composite
def points(draw: Draw, space: WorkSpace) -> Point:
    """Draw a point of the work space, its borders included."""
    share = number(0, 1)
    if space.max_radius:
        radius = space.radius_min + (space.max_radius - space.radius_min) * draw(share)
        radius *= 1 - 1e-12 if radius > space.radius_min * 2 else 1 + 1e-12
        angle = draw(number(-math.pi, math.pi))
        x, y = radius * math.cos(angle), radius * math.sin(angle)
    else:
        x, y = (min(a + (b - a) * draw(share), b) for a, b in zip(space.low[:2], space.high[:2], strict=True))
    floor, top = space.low[2], ceiling(space, x, y)
    return (x, y, min(floor + (top - floor) * draw(share), top))

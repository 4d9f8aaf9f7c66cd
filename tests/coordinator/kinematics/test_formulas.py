"""Every kinematics, on random machines: the formulas both ways, and that the work space is reachable."""

import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.kinematics.base import Kinematics, Point, StepFunction, WorkSpace
from coordinator.kinematics.delta import Delta
from coordinator.kinematics.deltesian import Deltesian
from coordinator.kinematics.rotary_delta import RotaryDelta
from tests.coordinator.kinematics.machines import MACHINES, number, points

EVERY = pytest.mark.parametrize("name", MACHINES)
STEP = 1e-4
"""mm, for differences."""


def machine_and_point(data: st.DataObject, name: str) -> tuple[Kinematics, Point]:
    machine = data.draw(MACHINES[name])
    return machine, data.draw(points(machine.work_space))


@EVERY
@given(data=st.data())
def test_forward_undoes_inverse_over_the_work_space(name: str, data: st.DataObject) -> None:
    machine, point = machine_and_point(data, name)
    again = machine.forward(machine.inverse(point))
    assert again == pytest.approx(point, abs=1e-6)


@EVERY
@given(data=st.data())
def test_inverse_undoes_forward(name: str, data: st.DataObject) -> None:
    machine, point = machine_and_point(data, name)
    positions = machine.inverse(point)
    assert machine.inverse(machine.forward(positions)) == pytest.approx(positions, abs=1e-6)


@EVERY
@given(data=st.data())
def test_the_names_fit(name: str, data: st.DataObject) -> None:
    machine, point = machine_and_point(data, name)
    assert machine.name == name
    assert len(machine.rails) == len(machine.step_functions()) == len(machine.inverse(point))
    homed = [rail for group in machine.homing_order for rail in group]
    assert len(set(homed)) == len(homed)
    if name != "generic_cartesian":
        assert set(homed) <= set(machine.rails)


def upper_arm_angle(params: tuple[float, ...], point: Point) -> float:
    """Find the angle by bisection on the lower arm's length, instead of by the formula."""
    upper, lower, radius, height, cos, sin = params
    outward, beside = point[0] * cos + point[1] * sin, point[1] * cos - point[0] * sin

    def too_long(angle: float) -> float:
        elbow = (radius + upper * math.cos(angle), 0.0, height + upper * math.sin(angle))
        return math.dist(elbow, (outward, beside, point[2])) - lower

    # From the elbow's nearest place, outwards and up, the lower arm gets longer.
    low = math.atan2(point[2] - height, outward - radius)
    high = low + math.pi
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (low, middle) if too_long(middle) > 0 else (middle, high)
    return math.remainder(low, math.tau)


Formula = Callable[[tuple[float, ...], Point], float]

FORMULAS: dict[str | None, Formula] = {
    None: lambda p, at: p[0] * at[0] + p[1] * at[1] + p[2] * at[2],
    "delta": lambda p, at: at[2] + math.sqrt(p[0] - (p[1] - at[0]) ** 2 - (p[2] - at[1]) ** 2),
    "deltesian": lambda p, at: at[2] + math.sqrt(p[0] - (p[1] - at[0]) ** 2),
    "polar_radius": lambda _, at: math.hypot(at[0], at[1]),
    "polar_angle": lambda _, at: math.atan2(at[1], at[0]),
    "winch": math.dist,
    "rotary_delta": upper_arm_angle,
}
"""A rail's position as step generation is to compute it, from the parameters (LINEAR: the weights) alone."""


def evaluate(function: StepFunction, point: Point) -> float:
    linear = function.formula is None
    return FORMULAS[function.formula](function.weights if linear else function.params, point)


@EVERY
@given(data=st.data())
def test_step_generation_is_told_the_same(name: str, data: st.DataObject) -> None:
    machine, point = machine_and_point(data, name)
    positions = [evaluate(function, point) for function in machine.step_functions()]
    assert positions == pytest.approx(machine.inverse(point), abs=1e-9)


@EVERY
@given(data=st.data())
def test_no_rail_is_much_faster_than_the_head(name: str, data: st.DataObject) -> None:
    """What the work space is for: no rail comes near a place where it would need to be infinitely fast."""
    machine, point = machine_and_point(data, name)
    allowed = {"deltesian": 1 / math.tan(math.radians(5)), "polar": math.inf, "generic_cartesian": 6}
    direction = data.draw(st.tuples(number(-1, 1), number(-1, 1), number(-1, 1)).filter(any))
    length = math.hypot(*direction) or 1.0
    inward = [-1 if p > 0 else 1 for p in point]  # stay inside
    near = tuple(p + s * STEP * abs(d) / length for p, s, d in zip(point, inward, direction, strict=True))
    before, after = machine.inverse(point), machine.inverse((near[0], near[1], near[2]))
    scale = [f.lever_mm or 1.0 for f in machine.step_functions()]
    for a, b, mm_per_unit in zip(before, after, scale, strict=True):
        assert abs(b - a) * mm_per_unit <= STEP * (allowed.get(name, 1 + math.hypot(3, 1)) + 1e-3)


TOWERS = pytest.mark.parametrize("name", ["delta", "deltesian", "rotary_delta"])


def endstops(machine: Kinematics) -> tuple[float, ...]:
    """Return where the towers' or arms' endstops are."""
    if isinstance(machine, RotaryDelta):
        return machine.endstop_positions
    assert isinstance(machine, Delta | Deltesian)
    return machine.endstop_positions


@TOWERS
@given(data=st.data())
def test_no_endstop_is_overrun_in_the_work_space(name: str, data: st.DataObject) -> None:
    machine, point = machine_and_point(data, name)
    for position, end in zip(machine.inverse(point), endstops(machine), strict=False):
        assert position <= end + 1e-6


@TOWERS
@given(data=st.data())
def test_no_endstop_is_overrun_on_the_way_through_the_cone(name: str, data: st.DataObject) -> None:
    machine = data.draw(MACHINES[name])
    space = machine.work_space
    ends = endstops(machine)
    one, two = (data.draw(points(space).filter(lambda p: in_cone(space, p))) for _ in range(2))
    for i in range(11):
        x, y, z = (a + (b - a) * i / 10 for a, b in zip(one, two, strict=True))
        assert all(u <= end + 1e-6 for u, end in zip(machine.inverse((x, y, z)), ends, strict=False))


def in_cone(space: WorkSpace, point: Point) -> bool:
    down = math.hypot(space.cone_slope[0] * point[0], space.cone_slope[1] * point[1])
    return point[2] <= space.cone_top - down


@TOWERS
@given(data=st.data())
def test_homing_ends_in_the_cone_or_at_its_tip(name: str, data: st.DataObject) -> None:
    machine = data.draw(MACHINES[name])
    y = (0.0,) if name == "deltesian" else ()
    home = machine.forward((*endstops(machine), *y))
    assert machine.inverse(home)[: len(endstops(machine))] == pytest.approx(endstops(machine), abs=1e-6)
    assert home[2] >= machine.work_space.cone_top - 3

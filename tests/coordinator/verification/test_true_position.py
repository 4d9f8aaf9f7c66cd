"""Where the head truly is, against where the plan ends; the counts are made by hand."""

import numpy as np
import pytest

from coordinator.assembly.load import load_machine
from coordinator.motion.trapezoid_array import TRAPEZOID
from coordinator.streaming.pipeline import PlanRecord
from coordinator.support.examples import DEMO_MACHINE
from coordinator.verification.true_position import prove_places
from coordinator.virtual_machine.plant import machine_plants
from nodes.virtual.plant import Axis
from nodes.virtual.plant_page import Motor

DESCRIPTION = load_machine(str(DEMO_MACHINE))
AXES = {axis.name: axis for plant in machine_plants(DESCRIPTION).values() for axis in plant.axes}


def plan() -> PlanRecord:
    """Home, then 10 mm in X from 0 in three phases of 2, 6 and 2 mm."""
    record = PlanRecord((0.0, 0.0, 0.0, 0.0))
    record.declared.append((0, (0.0, 0.0, 0.0, 0.0)))
    move = np.zeros(1, TRAPEZOID)
    move["accel_s"] = move["decel_s"] = 0.4
    move["accel"], move["cruise_v"], move["cruise_s"] = 25.0, 10.0, 0.6
    move["ratio"] = (1.0, 0.0, 0.0, 0.0)
    record.add(move.tobytes())
    return record


def motors(axes: dict[str, Axis], *, x: float, missed: int = 0) -> dict[str, dict[str, Motor]]:
    """The motors of the corexy with the head at X; the first has missed so many steps."""
    counts: dict[str, dict[str, Motor]] = {}
    for name, axis in axes.items():
        for term in axis.terms:
            way = (x if name == "x" else 0.0) - axis.origin
            share = way / sum(abs(t.mm_per_step) for t in axis.terms) * np.sign(term.mm_per_step)
            known = counts.setdefault(term.node, {}).get(term.stepper, Motor(0, 0, 0)).count
            counts[term.node][term.stepper] = Motor(known + round(share), 0, 0)
    first = axes["x"].terms[0]
    counts[first.node][first.stepper] = Motor(counts[first.node][first.stepper].count - missed, 0, 0)
    return counts


def test_places_that_agree() -> None:
    proofs = prove_places(DESCRIPTION, plan(), AXES, motors(AXES, x=10.0))
    assert [proof.axis for proof in proofs] == ["x", "y", "z"]
    assert all(proof.holds for proof in proofs), proofs
    assert proofs[0].believed_mm == pytest.approx(10.0)
    assert proofs[0].true_mm == pytest.approx(10.0, abs=0.01)


def test_an_axis_that_missed_steps() -> None:
    proofs = prove_places(DESCRIPTION, plan(), AXES, motors(AXES, x=10.0, missed=8))
    assert [proof.axis for proof in proofs if not proof.holds] == ["x", "y"]


def test_what_was_not_homed_is_not_judged() -> None:
    record = plan()
    record.declared.clear()
    assert prove_places(DESCRIPTION, record, AXES, motors(AXES, x=0.0)) == []

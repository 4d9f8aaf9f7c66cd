"""From the nodes' counts back to where the head is, for the machines of all kinematics."""

from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.model import MachineDescription
from coordinator.kinematics.dual_carriage import CarriageMode
from coordinator.motion.planner.planner import Position
from coordinator.runtime.stepper_positions import StepperPositions
from coordinator.support.examples import EXAMPLES
from coordinator.virtual_machine.plant import start_point

CONFIGS = sorted(path for path in EXAMPLES.glob("*.cfg") if path.stem != "none")  # whose head stands


def counts_at(machine: MachineDescription, position: Position, zero_mm: float) -> dict[str, int]:
    """Return what nodes count with the head at POSITION, the rails having begun at ZERO_MM (or rad)."""
    rails = dict(zip(machine.kinematics.rails, machine.kinematics.inverse(position[:3]), strict=True))
    found = {}
    for stepper in machine.steppers:
        own = next((r.axis for r in machine.rails if stepper in r.steppers and r.axis in rails), stepper.name)
        place = rails.get(own, position[3] if stepper.weights[3] else 0.0)
        found[stepper.name] = round((place - zero_mm) / stepper.step_distance)
    return found


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_counts_tell_where_the_head_is(path: Path) -> None:
    machine = load_machine(str(path))
    first = (*start_point(machine, 20.0), 1.0)
    later = (*start_point(machine, 43.0), 4.0)
    rails = StepperPositions(machine)
    assert rails.positions({}) == {}
    assert rails.head({}) is None
    state = None if machine.dual_carriage is None else machine.dual_carriage.carriages.home
    rails.declare(first, counts_at(machine, first, 0.3), state)
    counts = counts_at(machine, later, 0.3)
    places = rails.positions(counts)
    assert rails.head(places) == pytest.approx(later[:3], abs=0.2)  # a step of a bed that turns is 0.1 mm
    for extruder in machine.extruders[:1]:
        assert places[extruder.stepper.name] == pytest.approx(4.0, abs=extruder.stepper.step_distance)


def test_the_head_is_where_the_carriage_is_that_prints() -> None:
    machine = load_machine(str(EXAMPLES / "idex.cfg"))
    assert machine.dual_carriage is not None
    dual = machine.dual_carriage.carriages
    rails, zeros = StepperPositions(machine), {stepper.name: 0 for stepper in machine.steppers}
    rails.declare((-50.0, 0.0, 0.0, 0.0), zeros, dual.home)
    per_mm = round(1 / next(s for s in machine.steppers if s.name == "stepper_x").step_distance)
    counts = zeros | {"stepper_x": 100 * per_mm, "dual_carriage": -60 * per_mm}
    places = rails.positions(counts)
    assert (places["stepper_x"], places["dual_carriage"]) == pytest.approx((50, 290))
    assert rails.head(places) == pytest.approx((50, 0, 0))
    rails.use(dual.set_mode(dual.home, 50.0, 1, CarriageMode.PRIMARY))
    assert rails.head(places) == pytest.approx((290, 0, 0))

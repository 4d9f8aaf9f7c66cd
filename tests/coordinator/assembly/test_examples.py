"""Every example machine plans a program, and each stepper makes as many steps as its kinematics says."""

import itertools
import math
from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.model import MachineDescription
from coordinator.kinematics.base import Point
from coordinator.modules.homing.homing_override import HomingOverride
from coordinator.modules.module_set import build_modules
from coordinator.planning.options import PlanOptions
from coordinator.planning.plan import plan_file
from coordinator.support.examples import EXAMPLES

SAMPLES = 2000
EXAMPLE_FILES = sorted(path for path in EXAMPLES.glob("*.cfg") if path.stem != "none")  # whose head stands


def corners(machine: MachineDescription) -> list[Point]:
    """Return a way through the work space: down from where homing leaves the head, then around."""
    space = machine.kinematics.work_space
    z = [
        space.low[2] + (min(space.high[2], 300.0) - space.low[2]) * share for share in (0.05, 0.1, 0.15, 0.05)
    ]
    if space.max_radius:
        r = (space.radius_min + space.max_radius) / 2
        around = [(r * math.cos(a), r * math.sin(a)) for a in (0.1, 0.9, 1.7, 2.5)]
    else:
        x, y = ((low + high) / 2 for low, high in zip(space.low[:2], space.high[:2], strict=True))
        dx, dy = (
            min((high - low) / 4, 60.0) for low, high in zip(space.low[:2], space.high[:2], strict=True)
        )
        around = [(x - dx, y - dy), (x + dx, y - dy), (x + dx, y + dy), (x - dx, y)]
    return [(*xy, height) for xy, height in zip(around, z, strict=True)]


def travelled(machine: MachineDescription, way: list[Point]) -> list[float]:
    """Return how far each rail goes back and forth along the straight lines of WAY."""
    total = [0.0] * len(machine.kinematics.rails)
    for start, end in itertools.pairwise(way):
        before = machine.kinematics.inverse(start)
        for i in range(1, SAMPLES + 1):
            x, y, z = (a + (b - a) * i / SAMPLES for a, b in zip(start, end, strict=True))
            after = machine.kinematics.inverse((x, y, z))
            total = [t + abs(b - a) for t, a, b in zip(total, before, after, strict=True)]
            before = after
    return total


def steps(path: Path, folder: Path, lines: list[str]) -> dict[str, int]:
    """Return how many steps each stepper is planned to make."""
    gcode = folder / "way.gcode"
    gcode.write_text("\n".join(lines) + "\n")
    return {
        stepper.name: stepper.steps for stepper in plan_file(PlanOptions(config=path, gcode=gcode)).steppers
    }


@pytest.mark.parametrize("path", EXAMPLE_FILES, ids=lambda path: path.stem)
def test_the_example_is_planned(tmp_path: Path, path: Path) -> None:
    machine = load_machine(str(path))
    way = [machine.home, *corners(machine)]
    lines = [f"G1 X{x:.9f} Y{y:.9f} Z{z:.9f} F6000" for x, y, z in way[1:]]
    made = steps(path, tmp_path, ["G28", "M83", *lines, "G1 E10"])
    if build_modules(machine).names(HomingOverride):  # it moves, and ends elsewhere
        way = way[1:]
        made = {name: made[name] - count for name, count in steps(path, tmp_path, ["G28", lines[0]]).items()}
    rails = dict(zip(machine.kinematics.step_functions(), travelled(machine, way), strict=False))
    for stepper in machine.motors:
        expected = rails.get(stepper.function, 0.0) / stepper.step_distance  # a parked carriage: 0
        rounding = 2 + 2 * len(way) + (1e-3 * expected if machine.shapers else 0)  # shaped corners are cut
        assert made[stepper.name] == pytest.approx(expected, abs=rounding), stepper.name
    assert machine.extruder is not None
    assert made["extruder"] == pytest.approx(10 / machine.extruder.stepper.step_distance, abs=1)
    assert all(made[e.name] == 0 for e in machine.extruders[1:])

"""Sliced programs on real machines: the emitted commands against the exact motion.

Here the steps of a few short windows and the number of all steps; ``python bench/motion.py --prove``
compares every single one.
"""

from pathlib import Path

import pytest

from coordinator.motion.steps import MAX_ERROR_S
from tests.coordinator.motion.exact_program import Planned, plan_program

DATA = Path(__file__).parents[4] / "shared" / "data"
MACHINES = ("cartesian_plain", "corexy_is_pa", "corexy_is_pa_toolhead")
PROGRAMS = ("text_cube", "vase")
WINDOWS = 24
WINDOW_S = 0.25


def planned(program: str, machine: str) -> Planned:
    gcode, config = DATA / "gcode" / f"{program}.gcode", DATA / "config" / f"{machine}.cfg"
    for path in (gcode, config):
        if not path.exists():
            pytest.skip(f"{path} is not there: the sliced programs are no part of the project")
    return plan_program(config, gcode)


@pytest.mark.parametrize("machine", MACHINES)
@pytest.mark.parametrize("program", PROGRAMS)
def test_the_commands_make_the_exact_motion(program: str, machine: str) -> None:
    plan = planned(program, machine)
    share = plan.print_time_s / WINDOWS
    windows = [(share * (i + 0.5), share * (i + 0.5) + WINDOW_S) for i in range(WINDOWS)]
    verdicts = plan.prove(windows)
    assert {v.name for v in verdicts} == {"stepper_x", "stepper_y", "stepper_z", "extruder"}
    for verdict in verdicts:
        assert verdict.outside == 0, f"{verdict.name} at {verdict.outside_s} s"
        assert verdict.worst_s <= MAX_ERROR_S * 1.001
        assert verdict.position == verdict.wanted_position
        assert verdict.emitted == verdict.wanted - plan.left_out(verdict.name)
    assert sum(v.checked for v in verdicts) > 50_000

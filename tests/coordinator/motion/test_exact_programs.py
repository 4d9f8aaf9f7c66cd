"""Sliced programs on real machines: the emitted commands against the exact motion.

Here the steps of a few short windows and the number of all steps, of a program's first part in profile
``ci`` and of the whole in ``full``; ``python bench/motion.py --prove`` compares every single one.
"""

from itertools import product
from pathlib import Path

import pytest

from coordinator.motion.steps.steps import MAX_ERROR_S
from coordinator.verification.planned import segments
from tests.coordinator.motion.exact_program import Planned, plan_program
from tests.profiles import is_full

DATA = Path(__file__).parents[4] / "shared" / "data"
MACHINES = ("cartesian_plain", "corexy_is_pa", "corexy_is_pa_toolhead")
PROGRAMS = ("text_cube", "vase")
CI_PLANS = (
    ("text_cube", "cartesian_plain"),
    ("text_cube", "corexy_is_pa_toolhead"),
    ("vase", "corexy_is_pa"),
)
"""What ``ci`` plans of them: each machine once, each program."""
WINDOWS = 24
WINDOW_S = 0.25
CI_LINES = 2000
"""What ``ci`` plans of a program: its first layers."""


def planned(folder: Path, program: str, machine: str) -> Planned:
    gcode, config = DATA / "gcode" / f"{program}.gcode", DATA / "config" / f"{machine}.cfg"
    for path in (gcode, config):
        if not path.exists():
            pytest.skip(f"{path} is not there: the sliced programs are no part of the project")
    if not is_full():
        lines = gcode.read_text(encoding="utf-8").splitlines(keepends=True)
        gcode = folder / gcode.name
        gcode.write_text("".join(lines[:CI_LINES]), encoding="utf-8")
    return plan_program(config, gcode)


@pytest.mark.parametrize(("program", "machine"), product(PROGRAMS, MACHINES) if is_full() else CI_PLANS)
def test_the_commands_make_the_exact_motion(tmp_path: Path, program: str, machine: str) -> None:
    plan = planned(tmp_path, program, machine)
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


CONFIG = Path(__file__).parents[3] / "config"
ZIGZAG = (
    "G1 X30.013 Y20.007 E0.731 F9000", "G1 X31.5 Y42.3 E0.731", "G1 X60.1 Y21.7 E0.731", "G1 E-0.6 F1800",
    "G1 E0.6",
)  # fmt: skip
CHANGES = {
    "shapers": (
        "corexy",
        (
            "SET_INPUT_SHAPER SHAPER_TYPE=mzv SHAPER_FREQ_X=47.3 SHAPER_FREQ_Y=38.1",
            "SET_INPUT_SHAPER SHAPER_TYPE_X=ei SHAPER_FREQ_Y=0",
            "SET_PRESSURE_ADVANCE ADVANCE=0.043 SMOOTH_TIME=0.03",
            "SET_PRESSURE_ADVANCE ADVANCE=0.02",
            "SET_INPUT_SHAPER SHAPER_FREQ_X=0",
            "G28 X",
            "SET_PRESSURE_ADVANCE SMOOTH_TIME=0.05",
        ),
    ),
    "extruders": (
        "extruders",
        (
            "T1",
            "SET_PRESSURE_ADVANCE ADVANCE=0.05 SMOOTH_TIME=0.021",
            "SYNC_EXTRUDER_MOTION EXTRUDER=extruder MOTION_QUEUE=extruder1",
            "T0",
            "SYNC_EXTRUDER_MOTION EXTRUDER=extruder MOTION_QUEUE=extruder",
            "SET_INPUT_SHAPER SHAPER_FREQ_X=51 SHAPER_TYPE=2hump_ei",
            "T1",
        ),
    ),
    "carriages": (
        "idex",
        (
            "SET_DUAL_CARRIAGE CARRIAGE=1\nG1 X250.007 F9000\nSET_DUAL_CARRIAGE CARRIAGE=0",
            "SET_DUAL_CARRIAGE CARRIAGE=1 MODE=COPY",
            "SET_INPUT_SHAPER SHAPER_FREQ_X=44 SHAPER_TYPE=zvd",
            "SET_DUAL_CARRIAGE CARRIAGE=1 MODE=MIRROR",
            "T1",
        ),
    ),
    "towers": (
        "delta",
        (
            "SET_INPUT_SHAPER SHAPER_FREQ_X=49 SHAPER_FREQ_Y=41",
            "G92 E0",
            "SET_INPUT_SHAPER SHAPER_TYPE=3hump_ei",
        ),
    ),
}


@pytest.mark.parametrize("what", CHANGES)
def test_every_step_is_right_when_the_machine_changes_on_the_way(tmp_path: Path, what: str) -> None:
    machine, changes = CHANGES[what]
    gcode = tmp_path / "changes.gcode"
    body = "\n".join(ZIGZAG)
    gcode.write_text("\n".join(["G28\nG90\nM83\nG1 Z3.3 F300", body, *(f"{c}\n{body}" for c in changes)]))
    plan = plan_program(CONFIG / f"{machine}.cfg", gcode)
    cut = segments(plan.record)
    assert len(cut) > 2
    assert sum(len(stretch.moves) for stretch in cut) == plan.record.count
    verdicts = plan.prove()
    for verdict in verdicts:
        assert verdict.outside == 0, f"{verdict.name} at {verdict.outside_s} s"
        assert verdict.checked == verdict.emitted
        assert verdict.position == verdict.wanted_position
        assert verdict.emitted == verdict.wanted - plan.left_out(verdict.name)
    assert sum(v.checked > 500 for v in verdicts) >= 3

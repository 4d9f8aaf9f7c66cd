"""A program that probes is planned: what only a machine can find out is left out, and the plan goes on."""

from pathlib import Path

import pytest

from coordinator.planning.options import PlanOptions
from coordinator.planning.plan import plan_file
from tests.stages.printer_text import section
from tests.stages.probe_stage import machine_text

SECTIONS = (
    section("safe_z_home", home_xy_position="100, 100", z_hop=8)
    + section("bed_screws", screw1="10, 10", screw2="100, 10", screw3="50, 90")
    + section(
        "z_tilt", z_positions="\n  -20, 100\n  220, 0\n  220, 200", points="\n  10, 90\n  170, 10\n  170, 180"
    )
)
LINES = (
    *(
        "G28",
        "G1 Z9 F600",
        "Z_TILT_ADJUST",
        "PROBE",
        "PROBE_ACCURACY",
        "PROBE_CALIBRATE",
        "TESTZ Z=-1",
        "ABORT",
    ),
    *("QUERY_PROBE", "BED_SCREWS_ADJUST", "ACCEPT", "ABORT", "G28 Z", "G1 X50 Y50 Z3 F6000"),
)


@pytest.mark.parametrize("activate", ["", "M118 out"])
def test_a_program_that_probes_is_planned_to_its_end(tmp_path: Path, activate: str) -> None:
    """Without lines to activate the probe, and with them."""
    path, gcode = tmp_path / "machine.cfg", tmp_path / "part.gcode"
    path.write_text(machine_text(further_z=2, sections=SECTIONS, activate_gcode=activate))
    gcode.write_text("\n".join(LINES))
    report = plan_file(PlanOptions(config=path, gcode=gcode, json=True))
    assert report.moves > 10, "also those behind what is only probed on a machine"

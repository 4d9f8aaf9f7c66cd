"""[bed_mesh] in programs that only plan, and what front ends get of it; what it is on a bed: tests/sim."""

from pathlib import Path

import pytest

from coordinator.gcode.parser import WordError
from coordinator.modules.compensation.bed_mesh import BedMesh
from tests.stages.program_stage import ProgramStage

LARGE = "[bed_mesh]\nmesh_min: 10, 10\nmesh_max: 190, 190\nprobe_count: 40, 40\nalgorithm: bicubic\n"
TILTED = """
[bed_mesh]
mesh_min: 10, 10
mesh_max: 90, 90
probe_count: 3, 3
[bed_mesh tilted]
version: 1
points:
    0.0, 0.1, 0.2
    0.0, 0.1, 0.2
    0.0, 0.1, 0.2
min_x: 10
max_x: 90
min_y: 10
max_y: 90
x_count: 3
y_count: 3
mesh_x_pps: 2
mesh_y_pps: 2
algo: lagrange
tension: 0.2
"""


def test_a_client_asks_about_so_many_points_and_no_more(tmp_path: Path) -> None:
    """Failed before: 10,000 points held the control loop for 58 ms, with faulty regions for 237 ms."""
    (mesh,) = ProgramStage(tmp_path, LARGE).modules.of(BedMesh)
    for counts in ("100, 100", "30, 34"):
        with pytest.raises(WordError, match="is too large to be asked about, 1,000 are possible"):
            mesh.dump({"PROBE_COUNT": counts})
    few = mesh.dump({"PROBE_COUNT": "25, 40"})["calibration"]
    assert isinstance(few, dict)
    assert len(few["points"]) == 1000
    # The configuration may have more: what it means is found while it is loaded.
    first, second = (mesh.dump({})["calibration"] for _ in range(2))
    assert first is second
    assert isinstance(first, dict)
    assert len(first["points"]) == 1600
    assert first["config"] == few["config"] | {"x_count": 40}


def test_an_offset_that_is_refused_is_not_kept(tmp_path: Path) -> None:
    """Failed before: no mesh could be followed any more."""
    machine = ProgramStage(tmp_path, TILTED)
    machine.run("G28", "G1 X50 Y50 Z5 F6000", "BED_MESH_PROFILE LOAD=tilted", "BED_MESH_OFFSET X=20")
    followed = machine.planner.toolhead_position
    assert "X of BED_MESH_OFFSET is 1e+07; -100000 to 100000" in machine.error("BED_MESH_OFFSET X=1e7")
    machine.run("BED_MESH_CLEAR", "BED_MESH_PROFILE LOAD=tilted")
    assert machine.planner.toolhead_position == followed

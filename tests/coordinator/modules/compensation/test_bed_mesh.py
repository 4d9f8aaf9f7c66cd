"""What front ends get of a mesh is bounded: it is made on the control loop, for whoever asks."""

from pathlib import Path

import pytest

from coordinator.gcode.parser import WordError
from coordinator.modules.compensation.bed_mesh import BedMesh
from tests.stages.program_stage import ProgramStage

SECTION = "[bed_mesh]\nmesh_min: 10, 10\nmesh_max: 190, 190\nprobe_count: 40, 40\nalgorithm: bicubic\n"


def test_a_client_asks_about_so_many_points_and_no_more(tmp_path: Path) -> None:
    """Failed before: 10,000 points held the control loop for 58 ms, with faulty regions for 237 ms."""
    (mesh,) = ProgramStage(tmp_path, SECTION).modules.of(BedMesh)
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

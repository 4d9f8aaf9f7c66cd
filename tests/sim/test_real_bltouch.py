"""An Ender 5 S1 by its published configuration, in virtual time.

Its BLTouch measures in touch mode; [safe_z_home], [screws_tilt_adjust] and [bed_mesh] use it.
"""

import re
from pathlib import Path

import pytest

from coordinator.virtual_machine.plant import PlantSettings
from coordinator.virtual_machine.plant_bed import BedSettings
from nodes.virtual.plant import Bed
from tests.profiles import is_full
from tests.stages.machine_stage import MachineStage
from tests.stages.probe_stage import bed_height

REAL = Path(__file__).parents[2] / ".." / "shared" / "data" / "config" / "real"
ENDER = REAL / "klipper" / "printer-creality-ender5-s1-2023.cfg"


def test_a_bltouch_measures_its_bed(tmp_path: Path) -> None:
    if not ENDER.is_file():
        pytest.skip(f"there is no {ENDER}")
    path = tmp_path / "printer.cfg"
    path.write_text(ENDER.read_text())
    shape = Bed(x0=110, y0=110, tilt_x=0.001, tilt_y=-0.0005, bow=0.1 if is_full() else 0.0, radius=150)
    stage = MachineStage(path, plant=PlantSettings(bed=BedSettings(shape=shape), start=(180, 190, 20)))
    output: list[str] = []
    lines = ["G28", "SCREWS_TILT_CALCULATE SAMPLES=1"] + ["BED_MESH_CALIBRATE"] * is_full()
    stage.print_lines(lines, on_output=lambda told: output.append(told.text))
    found = [match for text in output if (match := re.match(r"probe at (\S+),(\S+) is z=(\S+)", text))]
    assert len(found) == 4 + 16 * 4 * is_full()
    zero = bed_height(shape, 123 - 13, 83 + 27)
    for match in found:
        x, y, z = map(float, match.groups())
        assert z - 2.0 == pytest.approx(bed_height(shape, x, y) - zero, abs=0.006), (x, y)

"""A Voron 2.4 as its user configured it: homed by its probe, its gantry levelled, in virtual time.

The probe has g-code that waits for the nozzle to be cool, and takes the median of three samples.
"""

import re
from pathlib import Path

import pytest

from coordinator.virtual_machine.plant import PlantSettings
from coordinator.virtual_machine.plant_bed import BedSettings
from nodes.virtual.plant import Bed
from tests.stages.machine_stage import MachineStage
from tests.stages.probe_stage import heights

REAL = Path(__file__).parents[2] / ".." / "shared" / "data" / "config" / "real" / "users"
MACHINE = REAL / "Alex3DLabs_Klipper_Configs_Voron_2_4_R2_TAPConfig_printer_cfg.cfg"
CORNERS = {
    "stepper_z": (-60.0, -10.0),
    "stepper_z1": (-60.0, 420.0),
    "stepper_z2": (410.0, 420.0),
    "stepper_z3": (410.0, -10.0),
}
RAISED = {"stepper_z2": 3.0, "stepper_z3": 1.2}
Z_OFFSET = -1.365


def test_its_gantry_is_levelled(tmp_path: Path) -> None:
    if not MACHINE.is_file():
        pytest.skip(f"there is no {MACHINE}")
    # The only thing that this computer does not have is the temperature sensor of another one.
    text = re.sub(r"(?ms)^\[temperature_sensor raspberry_pi\].*?(?=^\[)", "", MACHINE.read_text())
    path = tmp_path / "printer.cfg"
    path.write_text(text)
    bed = BedSettings(shape=Bed(x0=175, y0=175, tilt_x=0.001), supports=CORNERS, raised_mm=RAISED)
    stage = MachineStage(path, plant=PlantSettings(bed=bed))
    output: list[str] = []
    stage.print_lines(
        [
            "G28",
            "QUAD_GANTRY_LEVEL",
            "G28 Z",
            "G1 X80 Y90 Z10 F6000",
            "PROBE",
            "G1 Z10 F600",
            "G1 X290 Y280",
            "PROBE",
        ],
        on_output=lambda told: output.append(told.text),
    )
    passes = [text for text in output if re.match(r"pass \d", text)]
    assert 2 <= len(passes) <= 4, output
    # In the middle the bed is where Z was homed; elsewhere it is as level as retry_tolerance demands.
    assert heights(output)[-6:] == pytest.approx([Z_OFFSET] * 6, abs=0.0075 + 0.002)

"""A Voron 2.4 as its user configured it, with KAMP: a print from PRINT_START to PRINT_END, in virtual time.

Its macros home by the probe, level the gantry, probe an adaptive mesh and purge a line. The probe has g-code
that waits for the nozzle to be cool; in profile ``full`` it takes the median of three samples, as configured.
"""

import re
from pathlib import Path

import pytest

from coordinator.runtime.machine import Machine
from coordinator.streaming.move_source import ProgramOutput
from coordinator.virtual_machine.plant import PlantSettings
from coordinator.virtual_machine.plant_bed import BedSettings
from coordinator.virtual_machine.plant_heat import HeatSettings
from nodes.virtual.plant import Bed
from tests.profiles import is_full
from tests.stages.machine_stage import MachineStage
from tests.stages.probe_stage import bed_height

REAL = Path(__file__).parents[2] / ".." / "shared" / "data" / "config" / "real"
MACHINE = REAL / "users" / "Alex3DLabs_Klipper_Configs_Voron_2_4_R2_TAPConfig_printer_cfg.cfg"
KAMP = REAL / "macros" / "kamp"
CORNERS = {
    "stepper_z": (-60.0, -10.0),
    "stepper_z1": (-60.0, 420.0),
    "stepper_z2": (410.0, 420.0),
    "stepper_z3": (410.0, -10.0),
}
RAISED = {"stepper_z2": 3.0, "stepper_z3": 1.2}
SHAPE = Bed(x0=175, y0=175, tilt_x=0.001, bow=0.2, radius=175)
LAYER_MM = 0.3
JOB = [
    "EXCLUDE_OBJECT_DEFINE NAME=a CENTER=150,160 POLYGON=[[130,140],[170,140],[170,180],[130,180]]",
    *("M190 S60", "PRINT_START EXTRUDER=215 BED=60"),
    *("EXCLUDE_OBJECT_START NAME=a", "G90", "M83", f"G1 Z{LAYER_MM} F600", "G1 X130 Y140 F12000", "M400"),
    *("M118 layer", "G1 X170 Y140 E2 F3000", "G1 X170 Y180 E2", "G1 X130 Y180 E2", "G1 X130 Y140 E2", "M400"),
    *("M118 end of layer", "EXCLUDE_OBJECT_END NAME=a", "PRINT_END"),
]


def configuration() -> str:
    """Return the user's file with the lines for KAMP switched on, as the user would."""
    text = MACHINE.read_text(encoding="utf-8")
    for name in ("Adaptive_Meshing", "Line_Purge", "Smart_Park"):
        path = (KAMP / f"{name}.cfg").resolve()
        text = text.replace(f"#[include ./KAMP/{name}.cfg]", f"[include {path}]")
    # The only thing that this computer does not have is the temperature sensor of another one.
    text = re.sub(r"(?ms)^\[temperature_sensor raspberry_pi\].*?(?=^\[)", "", text)
    if not is_full():
        text = text.replace("samples:3 ", "samples: 1")
    # Heat that is hurried needs control that is.
    return re.sub(r"(?m)^#\*# pid_.*\n", "", text.replace("control = pid", "control = watermark"))


def test_a_print_with_its_own_macros(tmp_path: Path) -> None:
    if not MACHINE.is_file():
        pytest.skip(f"there is no {MACHINE}")
    path = tmp_path / "printer.cfg"
    path.write_text(configuration())
    bed = BedSettings(shape=SHAPE, supports=CORNERS, raised_mm=RAISED)
    stage = MachineStage(path, plant=PlantSettings(bed=bed, heat=HeatSettings(hurry=30.0)))
    output: list[str] = []
    gaps: list[float] = []
    machines: list[Machine] = []

    def look() -> None:
        if "echo: end of layer" not in output:
            x, y = stage.true_mm("probe_x"), stage.true_mm("probe_y")
            z, by_x, by_y = (stage.true_mm(f"probe_{axis}") for axis in ("z", "slope_x", "slope_y"))
            gaps.append(z + by_x * x + by_y * y - bed_height(SHAPE, x, y))
            stage.at(0.02, look)

    def hear(said: ProgramOutput) -> None:
        output.append(said.text)
        if said.text == "echo: layer":
            look()

    outcome = stage.print_lines(JOB, on_output=hear, on_ready=machines.append)
    passes = [text for text in output if re.match(r"pass \d", text)]
    assert 2 <= len(passes) <= 4, output
    assert float(passes[-1].split()[5]) <= 0.0075, "retry_tolerance"
    assert "Adapted mesh bounds: (130.0, 140.0), (170.0, 180.0)." in output
    assert not [text for text in output if "no meaning" in text]
    status = machines[0].modules.status()
    assert (status["bed_mesh"]["mesh_min"], status["bed_mesh"]["mesh_max"]) == ([130, 140], [170, 180])
    assert len(gaps) > 100
    assert gaps == pytest.approx([LAYER_MM] * len(gaps), abs=0.010)
    assert outcome.positions == outcome.issued
    assert status["extruder"]["target"] == 0, "PRINT_END"

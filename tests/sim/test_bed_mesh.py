"""[bed_mesh] on a virtual bed in virtual time: what is probed and where the nozzle goes, by its formula."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.modules.compensation.bed_mesh import PROFILES_MAX
from coordinator.virtual_machine.plant_bed import BedSettings
from coordinator.virtual_machine.plant_heat import HeatSettings
from nodes.virtual.plant import Bed
from tests.stages.printer_text import section
from tests.stages.probe_stage import MICROSTEP_MM, OFFSET, START, ProbeStage, bed_height, machine_text

BOWED = BedSettings(shape=Bed(z=0.2, x0=100, y0=100, tilt_x=0.002, tilt_y=-0.001, bow=0.3, radius=120))
MESH: dict[str, object] = {
    "mesh_min": "30, 30",
    "mesh_max": "180, 170",
    "probe_count": "4, 3",
    "speed": 200,
}
HEATER: dict[str, object] = {
    "heater_pin": "PC8",
    "sensor_type": "Generic 3950",
    "sensor_pin": "PA3",
    "control": "watermark",
    "max_delta": 0.2,
    "min_temp": 0,
    "max_temp": 120,
}


def stage_with(folder: Path, **mesh: Any) -> ProbeStage:
    sections = section("bed_mesh", **MESH | mesh) + "[exclude_object]\n"
    return ProbeStage(folder, machine_text(sections=sections), bed=BOWED)


def truth(x: float, y: float) -> float:
    """Return how high the bed is above the place where G28 found its zero."""
    return bed_height(BOWED.shape, x, y) - bed_height(BOWED.shape, START[0] + OFFSET[0], START[1] + OFFSET[1])


def mapped(output: list[str]) -> Any:
    """Return what the last BED_MESH_MAP found."""
    text = [text for text in output if text.startswith("mesh_map_output")][-1]
    return json.loads(text.removeprefix("mesh_map_output"))


def status(stage: ProbeStage) -> Any:
    assert stage.machine is not None
    return stage.machine.modules.status()["bed_mesh"]


def gaps_of(stage: ProbeStage, *lines: str) -> tuple[list[str], list[float]]:
    """Run LINES; return what was said, and every 5 ms between M118 on and M118 off: nozzle above bed, mm."""
    gaps: list[float] = []

    def look() -> None:
        if "echo: on" in stage.output and "echo: off" not in stage.output:
            x, y = (stage.true_mm(axis) for axis in ("probe_x", "probe_y"))
            z = stage.true_mm("z")
            gaps.append(z - bed_height(BOWED.shape, x, y))
        stage.at(0.005, look)

    stage.at(0.005, look)
    return stage.do(*lines), gaps


LAYER = (
    *("G1 X40 Y40 F12000", "G1 Z0.3 F600", "M400", "M118 on", "G1 X170 Y150 F18000", "G1 X60 Y160"),
    *("G1 X175 Y45", "G1 X40 Y40", "M400", "M118 off"),
)


@pytest.mark.parametrize(("algorithm", "counts"), [("lagrange", "4, 3"), ("bicubic", "8, 8")])
def test_the_nozzle_follows_the_bed(tmp_path: Path, algorithm: str, counts: str) -> None:
    stage = stage_with(tmp_path, algorithm=algorithm, probe_count=counts, bicubic_tension=0.5)
    output, gaps = gaps_of(stage, "G28", "G1 Z5 F900", "BED_MESH_CALIBRATE", "BED_MESH_MAP", *LAYER)
    heights = np.array(mapped(output)["z_positions"])
    rows, columns = heights.shape
    exact = [[truth(x, y) for x in np.linspace(30, 180, columns)] for y in np.linspace(30, 170, rows)]
    assert heights == pytest.approx(np.array(exact), abs=0.005)
    assert len(gaps) > 300
    assert gaps == pytest.approx([0.3] * len(gaps), abs=0.010)


def test_the_mesh_of_a_warm_bed_is_its_own(tmp_path: Path) -> None:
    """The bed bows as it gets warm: its heater is on another node than the probe."""
    warm = replace(BOWED.shape, warm_bow=0.004)
    heater = section("heater_bed", **HEATER)
    text = machine_text(sections=section("bed_mesh", **MESH) + heater)
    stage = ProbeStage(tmp_path, text, bed=replace(BOWED, shape=warm), heat=HeatSettings(hurry=3.0))
    measure = ("G28", "G1 Z5 F900", "BED_MESH_CALIBRATE", "BED_MESH_MAP")
    cold, hot = (
        np.array(json.loads(text.removeprefix("mesh_map_output"))["z_positions"])
        for text in stage.do(*measure, "G1 X0 Y0 F6000", "M190 S60", *measure)
        if text.startswith("mesh_map_output")
    )
    exact = [[truth(x, y) for x in np.linspace(30, 180, 4)] for y in np.linspace(30, 170, 3)]
    assert cold == pytest.approx(np.array(exact), abs=0.005)
    bowed = replace(BOWED.shape, bow=BOWED.shape.bow + 0.004 * (60 - 25))
    bent = [
        [bed_height(bowed, x, y) - bed_height(bowed, 20, 10) for x in np.linspace(30, 180, 4)]
        for y in np.linspace(30, 170, 3)
    ]
    assert hot == pytest.approx(np.array(bent), abs=0.01)
    assert np.ptp(hot - cold) > 0.05


def test_without_a_mesh_the_nozzle_does_not(tmp_path: Path) -> None:
    stage = stage_with(tmp_path)
    _, gaps = gaps_of(stage, "G28", "G1 Z5 F900", "BED_MESH_CALIBRATE", "BED_MESH_CLEAR", *LAYER)
    assert np.ptp(gaps) > 0.2
    assert status(stage)["profile_name"] == ""


def test_taking_up_and_clearing_a_mesh_moves_nothing(tmp_path: Path) -> None:
    """The place has another Z then, and the next Z goes to where it should."""
    stage = stage_with(tmp_path)
    places: list[float] = []
    stage.when(lambda: "echo: a" in stage.output, lambda: places.append(stage.true_mm("z")))
    stage.when(lambda: "echo: b" in stage.output, lambda: places.append(stage.true_mm("z")))
    stage.when(lambda: "echo: c" in stage.output, lambda: places.append(stage.true_mm("z")))
    output = stage.do(
        *("G28", "G1 Z5 F900", "BED_MESH_CALIBRATE", "G1 X100 Y90 Z3 F6000", "M400", "M118 a", "G4 P50"),
        *("BED_MESH_CLEAR", "M114", "G4 P50", "M118 b", "G4 P50", "BED_MESH_PROFILE LOAD=default", "M114"),
        *("G1 Z3", "M400", "M118 c", "G4 P50"),
    )
    assert places == pytest.approx([places[0]] * 3, abs=MICROSTEP_MM)
    z = planned_z(output)
    assert z[0] == pytest.approx(3 + truth(100, 90), abs=0.006)
    assert z[1] == pytest.approx(3, abs=1e-3)


def test_homing_while_a_mesh_is_followed(tmp_path: Path) -> None:
    """The endstop tells where the motors are: Z above the bed is what it was."""
    home_again = ("BED_MESH_CALIBRATE", "G1 X0 Y0 Z5 F6000", "G28 X Y", "G1 Z4 F900", "G28 Z", "M114")
    output, gaps = gaps_of(stage_with(tmp_path), "G28", "G1 Z5 F900", *home_again, *LAYER)
    (z,) = planned_z(output)
    assert z == pytest.approx(OFFSET[2] - truth(30, 30), abs=0.006), "planned, above the edge of the mesh"
    assert gaps == pytest.approx([0.3] * len(gaps), abs=0.010)


def test_the_mesh_fades(tmp_path: Path) -> None:
    stage = stage_with(tmp_path, fade_start=1, fade_end=5)
    _, gaps = gaps_of(
        stage,
        *("G28", "G1 Z5 F900", "BED_MESH_CALIBRATE", "G1 X40 Y40 Z6 F6000", "M400", "M118 on"),
        *("G1 X170 Y150 F18000", "M400", "M118 off"),
    )
    target = np.mean(status(stage)["probed_matrix"])
    xs = np.array([40, 170])
    exact = [6 + target - truth(x, y) for x, y in zip(xs, (40, 150), strict=True)]
    assert [gaps[0], gaps[-1]] == pytest.approx(exact, abs=0.01)


def test_an_adaptive_mesh_is_around_the_objects(tmp_path: Path) -> None:
    stage = stage_with(tmp_path, adaptive_margin=5, probe_count="6, 6")
    define = "EXCLUDE_OBJECT_DEFINE NAME=PART CENTER=100,100 POLYGON=[[80,90],[120,90],[120,110],[80,110]]"
    output = stage.do(define, "G28", "G1 Z5 F900", "BED_MESH_CALIBRATE ADAPTIVE=1", "BED_MESH_MAP")
    found = mapped(output)
    assert (found["mesh_min"], found["mesh_max"]) == ([75, 85], [125, 115])
    assert np.array(found["z_positions"]).shape == (3, 3)


def test_the_zero_reference_is_zero(tmp_path: Path) -> None:
    stage = stage_with(tmp_path, zero_reference_position="100, 100")
    output = stage.do("G28", "G1 Z5 F900", "BED_MESH_CALIBRATE", "BED_MESH_MAP")
    corner = mapped(output)["z_positions"][0][0]
    assert corner == pytest.approx(truth(30, 30) - truth(100, 100), abs=0.005)


def planned_z(output: list[str]) -> list[float]:
    """Return what every M114 said of Z."""
    return [float(text.split("Z:")[1].split()[0]) for text in output if text.startswith("X:")]


def test_the_mesh_may_be_looked_up_elsewhere(tmp_path: Path) -> None:
    """BED_MESH_OFFSET, for a second nozzle: motors stay, and Z is what it is above the other place."""
    output = stage_with(tmp_path).do(
        *("G28", "G1 Z5 F900", "BED_MESH_CALIBRATE", "G1 X100 Y90 Z3 F6000", "M114"),
        *("BED_MESH_OFFSET X=20 Y=-10", "M114", "BED_MESH_OFFSET X=0", "M114"),
    )
    before, both, one = planned_z(output)
    assert both - before == pytest.approx(truth(100, 90) - truth(120, 80), abs=0.002)
    assert one - before == pytest.approx(truth(100, 90) - truth(100, 80), abs=0.002)


def test_a_faulty_region_is_not_probed(tmp_path: Path) -> None:
    region = {"faulty_region_1_min": "70, 20", "faulty_region_1_max": "90, 40"}
    stage = stage_with(tmp_path, **region)
    output = stage.do("G28", "G1 Z5 F900", "BED_MESH_OUTPUT PGP=1", "BED_MESH_CALIBRATE", "BED_MESH_MAP")
    assert not any(text.endswith("| 80.00, 30.00") for text in output)
    found = mapped(output)["z_positions"][0][1]
    assert found == pytest.approx((truth(70, 30) + truth(90, 30) + truth(80, 40)) / 3, abs=0.005)


def test_profiles_are_kept_saved_and_removed(tmp_path: Path) -> None:
    stage = stage_with(tmp_path)
    output = stage.do(
        *("G28", "G1 Z5 F900", "BED_MESH_CALIBRATE PROFILE=cold", "BED_MESH_PROFILE SAVE=warm"),
        *("BED_MESH_CLEAR", "BED_MESH_PROFILE LOAD=warm", "BED_MESH_OUTPUT", "BED_MESH_PROFILE REMOVE=cold"),
    )
    assert any(text.startswith("profile warm, lagrange, X 30 to 180") for text in output)
    told = status(stage)
    assert (told["profile_name"], list(told["profiles"])) == ("warm", ["warm"])
    assert told["mesh_min"] == [30, 30]
    assert np.array(told["mesh_matrix"]).shape == (7, 10)
    assert stage.machine is not None
    pending = stage.machine.unsaved.pending
    assert set(pending) == {"bed_mesh warm"}
    assert len(pending["bed_mesh warm"]["points"].split("\n")) == 3
    # What was saved is read again as the same profile.
    saved = "".join(
        f"{option}:{''.join(f'{chr(10)}  {line}' for line in text.split(chr(10)))}\n"
        for option, text in pending["bed_mesh warm"].items()
    )
    text = stage.config.read_text(encoding="utf-8") + f"[bed_mesh warm]\n{saved}"
    (tmp_path / "again").mkdir()
    again = ProbeStage(tmp_path / "again", text, bed=BOWED)
    output = again.do("G28", "BED_MESH_PROFILE LOAD=warm", "BED_MESH_MAP")
    assert mapped(output)["z_positions"] == told["probed_matrix"]


def test_profiles_have_a_limit_and_are_made_once_for_clients(tmp_path: Path) -> None:
    """Failed before: any number, each written out again at every look and saved on the control loop."""
    stage = stage_with(tmp_path)
    names = [f"p{n}" for n in range(PROFILES_MAX)]
    saves = [f"BED_MESH_PROFILE SAVE={name}" for name in (*names, "more")]
    with pytest.raises(Exception, match=f"there are {PROFILES_MAX} profiles already"):
        stage.do("G28", "G1 Z5 F900", "BED_MESH_CALIBRATE PROFILE=p0", *saves)
    first, second = status(stage)["profiles"], status(stage)["profiles"]
    assert [*first] == names
    assert all(first[name] is second[name] for name in names)


@pytest.mark.parametrize(
    ("line", "refused"),
    [
        ("BED_MESH_PROFILE LOAD=gone", "there is no 'gone'"),
        ("BED_MESH_PROFILE SAVE=x", "no mesh is followed"),
        (f"BED_MESH_PROFILE SAVE={'n' * 101}", "cannot be a profile's name"),
        ('BED_MESH_PROFILE SAVE="a  b"', "cannot be a profile's name"),
        ("BED_MESH_MAP", "no mesh is followed"),
        ("BED_MESH_CALIBRATE MESH_MIN=5", "two numbers"),
        ("BED_MESH_CALIBRATE PROBE_COUNT=9,9", "cannot be joined by lagrange"),
        ("BED_MESH_CALIBRATE MESH_MAX=10,10", "MESH_MAX is not beyond MESH_MIN"),
        ("BED_MESH_CALIBRATE METHOD=magic", "METHOD of BED_MESH_CALIBRATE is 'magic'"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, line: str, refused: str) -> None:
    with pytest.raises(Exception, match=refused):
        stage_with(tmp_path).do("G28", line)


def test_a_mesh_can_be_checked(tmp_path: Path) -> None:
    with pytest.raises(Exception, match=r"the mesh is 0\.\d+ mm from its lowest to its highest"):
        stage_with(tmp_path).do(
            "G28",
            "G1 Z5 F900",
            "BED_MESH_CALIBRATE",
            "BED_MESH_CHECK MAX_SLOPE=1",
            "BED_MESH_CHECK MAX_DEVIATION=0.01",
        )

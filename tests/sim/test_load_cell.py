"""[load_cell_probe] and [load_cell] on a virtual bed in virtual time, by the node's firmware and an HX71x."""

import ast
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.config.errors import ConfigError
from coordinator.gcode.errors import GCodeError
from coordinator.modules.load_cells.force_filters import high_pass, low_pass, notch
from coordinator.modules.load_cells.load_cell_probe import LoadCellProbe
from coordinator.modules.module_set import build_modules
from coordinator.virtual_machine.plant_bed import BedSettings, LoadCellSettings
from nodes.devices.analog_trigger import Section
from nodes.virtual.plant import Bed
from nodes.virtual.plant_page import PlantFault, PlantItemKind
from tests.profiles import is_full
from tests.stages.printer_text import section
from tests.stages.probe_stage import MICROSTEP_MM, ProbeStage, bed_height, heights, machine_text

KIND = "load_cell_probe"
SHAPE = Bed(z=0.2, x0=100, y0=100, tilt_x=0.002, tilt_y=-0.001, bow=0.3, radius=120)
CELL = LoadCellSettings(noise=50, rate=0.985)
"""It counts slowly, and a reading scatters by half a gram."""
ZERO, PER_GRAM = round(CELL.zero), CELL.counts_per_gram
RUNS = 50 if is_full() else 2
PULL_MM = 0.2


def stage_with(
    folder: Path, *, cell: LoadCellSettings = CELL, sections: str = "", seed: int = 1, **options: Any
) -> ProbeStage:
    folder.mkdir(exist_ok=True)
    text = machine_text(kind=KIND, sections=sections, **options)
    return ProbeStage(folder, text, bed=BedSettings(shape=SHAPE, load_cell=cell), seed=seed)


def fault(stage: ProbeStage, what: PlantFault) -> None:
    stage.page("toolhead").set_fault(PlantItemKind.LOAD_CELL, "probe", what)


def zero_error(stage: ProbeStage) -> float:
    """Return how far off the zero of Z is that G28 found at X 0, Y 0, mm."""
    assert stage.machine is not None
    counts = {name: motor.count for name, motor in stage.page("mcu").motors.items()}
    positions = stage.machine.stepper_positions
    head = positions.head(positions.positions(counts))
    assert head is not None
    return head[2] - (stage.true_mm("z") - bed_height(SHAPE, 0, 0))


# -------------------------------------------------------------------------------------------- what it finds


def test_homing_finds_the_bed_with_any_clocks_lost_frames_and_noise(tmp_path: Path) -> None:
    errors = []
    for seed in range(RUNS):
        stage = ProbeStage(
            tmp_path,
            machine_text(kind=KIND),
            seed=seed,
            loss=0.01,
            bed=BedSettings(shape=SHAPE, load_cell=CELL),
            start=(0.0, 0.0, 3.5 + 0.37 * seed % 3),
        )
        stage.do("G28")
        errors.append(zero_error(stage))
    assert max(map(abs, errors)) < MICROSTEP_MM, errors
    assert np.ptp(errors) < MICROSTEP_MM, errors


@pytest.mark.parametrize("rate", [80, 10, 320])
def test_probing_finds_the_bed_whatever_gives_way(tmp_path: Path, rate: int) -> None:
    chip: dict[str, Any] = (
        {"sensor_type": "hx717", "sample_rate": rate} if rate > 80 else {"sample_rate": rate}
    )
    slow = {"homing_speed": 1, "second_homing_speed": 0.5}
    stage = stage_with(tmp_path, speed=0.5, z=slow, **chip)
    output = stage.do(
        *("G28", "G1 Z1", "PROBE", "G1 Z2", "G1 X30 Y50 F6000", "PROBE SAMPLES=2", "G1 Z2", "G1 X150 Y20"),
        "PROBE",
    )
    found = heights(output)
    assert len(found) == 4
    places = [(0, 0), (30, 50), (30, 50), (150, 20)]
    exact = [bed_height(SHAPE, x, y) - bed_height(SHAPE, 0, 0) for x, y in places]
    assert found == pytest.approx(exact, abs=2 * MICROSTEP_MM)


def test_a_cable_that_drags_a_hum_and_an_inverted_cell_do_not_matter(tmp_path: Path) -> None:
    """With filters for them; the drag changes by 20 g/s, the hum has 30 g and is half of what triggers."""
    cell = LoadCellSettings(noise=50, rate=1.02, counts_per_gram=-100, drift=20, hum=30)
    filters: dict[str, Any] = {
        "drift_filter_cutoff_frequency": 0.8,
        "buzz_filter_cutoff_frequency": 100,
        "notch_filter_frequencies": "50, 60",
    }
    stage = stage_with(
        tmp_path, cell=cell, sensor_type="hx717", sensor_orientation="inverted", speed=2, **filters
    )
    output = stage.do("G28", "G1 X30 Y50 Z1 F6000", "PROBE")
    (found,) = heights(output)
    assert abs(zero_error(stage)) < 2 * MICROSTEP_MM
    assert found == pytest.approx(bed_height(SHAPE, 30, 50) - bed_height(SHAPE, 0, 0), abs=3 * MICROSTEP_MM)


def test_a_soft_print_surface_is_z_offset(tmp_path: Path) -> None:
    stage = stage_with(tmp_path, z_offset=0.1)
    stage.do("G28")
    assert zero_error(stage) == pytest.approx(0.1, abs=MICROSTEP_MM)


def test_without_a_lift_the_trigger_counts(tmp_path: Path) -> None:
    """Which is where the force is that triggers: 75 g at 4 kg/mm, and up to a reading later."""
    slow = {"homing_speed": 1, "second_homing_speed": 0.5}
    lifted, pressed = (
        stage_with(tmp_path / name, z=slow, pullback_distance=pull, trigger_force=200)
        for name, pull in (("lifted", PULL_MM), ("pressed", 0))
    )
    lifted.do("G28")
    pressed.do("G28")
    assert abs(zero_error(lifted)) < MICROSTEP_MM
    assert 0.045 < zero_error(pressed) < 0.06


def test_a_mesh_finds_the_shape_of_the_bed(tmp_path: Path) -> None:
    mesh = section("bed_mesh", mesh_min="30, 30", mesh_max="180, 170", probe_count="4, 3", speed=150)
    stage = stage_with(tmp_path, sections=mesh, sensor_type="hx717", speed=2, samples=2)
    output = stage.do("G28", "BED_MESH_CALIBRATE HORIZONTAL_MOVE_Z=1", "BED_MESH_MAP")
    (text,) = (line.removeprefix("mesh_map_output") for line in output if line.startswith("mesh_map_output"))
    exact = [[bed_height(SHAPE, x, y) for x in np.linspace(30, 180, 4)] for y in np.linspace(30, 170, 3)]
    found = np.array(json.loads(text)["z_positions"]) + bed_height(SHAPE, 0, 0)
    assert found == pytest.approx(np.array(exact), abs=0.005)


# ----------------------------------------------------------------------------------------------- what fails

HOMING = "Z was not homed: "
GARBLED = "the sensor (lost count of its clock: check the wires of dout_pin and sclk_pin|makes no readings)"
"""A chip that misses a pulse shows the last bit of its reading: 1 looks like a chip that is not ready."""


@pytest.mark.parametrize(
    ("what", "why"),
    [
        (PlantFault.DEAD, "the sensor makes no readings: check its supply and its wiring"),
        (PlantFault.OPEN, "the sensor makes no readings: check its supply and its wiring"),
        (PlantFault.SHORTED, "the force left its safe range: check that nothing presses against the nozzle"),
        (PlantFault.GARBLED, GARBLED),
        (PlantFault.NEVER, "the probe did not trigger within"),
    ],
)
def test_a_sensor_that_fails_on_the_way_down_stops_it_at_once(
    tmp_path: Path, what: PlantFault, why: str
) -> None:
    stage = stage_with(tmp_path)
    stage.when(lambda: stage.true_mm("z") < 2, lambda: fault(stage, what))
    with pytest.raises(GCodeError, match=why):
        stage.do("G28")
    if what is not PlantFault.NEVER:
        assert stage.true_mm("z") - bed_height(SHAPE, 0, 0) > 0.5, "not into the bed"


@pytest.mark.parametrize("what", [PlantFault.DEAD, PlantFault.SHORTED])
def test_a_sensor_that_failed_before_is_not_relied_upon(tmp_path: Path, what: PlantFault) -> None:
    stage = stage_with(tmp_path)
    with pytest.raises(GCodeError, match=r"\[load_cell_probe\]: the sensor"):
        stage.do("G28", on_ready=lambda _: fault(stage, what))
    assert stage.true_mm("z") == 8


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"counts_per_gram": None}, "it is not calibrated: calibrate with LOAD_CELL_CALIBRATE"),
        ({"reference_tare_counts": None}, "it is not calibrated"),
        (
            {"reference_tare_counts": ZERO + 201_000},
            r"the force at rest is -20(09|10|11) g",
        ),
        (
            {"reference_tare_counts": ZERO - 30_000, "force_safety_limit": 250},
            "the force at rest is (299|300|301) g",
        ),
        ({"pullback_distance": 0.02}, "the nozzle did not leave the bed"),
    ],
)
def test_what_cannot_be_measured_is_said(tmp_path: Path, options: Mapping[str, Any], why: str) -> None:
    stage = stage_with(tmp_path, **options)
    with pytest.raises(GCodeError, match=why):
        stage.do("G28")


def test_a_force_beyond_the_limit_ends_the_way_down(tmp_path: Path) -> None:
    """A filter that is too slow: the node sees the limit before it sees the trigger."""
    stage = stage_with(tmp_path, buzz_filter_cutoff_frequency=0.1, force_safety_limit=300, trigger_force=200)
    with pytest.raises(GCodeError, match="the force left its safe range"):
        stage.do("G28")
    deep = bed_height(SHAPE, 0, 0) - stage.true_mm("z")
    assert 300 / 4000 < deep < 0.35, "8 mm/s, a reading late"


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"sensor_type": "hx712"}, "hx711"),
        ({"sample_rate": 320}, "this chip can be wired for 80 or 10"),
        ({"gain": "B-64"}, "this chip has A-128, B-32 or A-64"),
        ({"sclk_pin": "PC6"}, "it has to be one of node toolhead"),
        ({"dout_pin": "!toolhead:PC5"}, "cannot be inverted"),
        ({"buzz_filter_cutoff_frequency": 40}, "a filter can only be for frequencies below 40 Hz"),
        ({"drift_filter_cutoff_frequency": 50}, "a filter can only be for frequencies below 40 Hz"),
        ({"notch_filter_frequencies": "50"}, "a filter can only be for frequencies below 40 Hz"),
        ({"notch_filter_frequencies": "1, many"}, "must be a number of Hz"),
        ({"notch_filter_frequencies": "1, 1_0"}, "must be a number of Hz"),
        ({"notch_filter_frequencies": "1, 2, 3, 4, 5"}, "more than 4"),
        ({"drift_filter_delay": 3}, "drift_filter_delay"),
        ({"trigger_force": 300, "force_safety_limit": 250}, "it has to be below force_safety_limit"),
        ({"x_offset": 5}, "x_offset"),
    ],
)
def test_what_cannot_be_configured_is_said(tmp_path: Path, options: Mapping[str, Any], why: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(why)):
        stage_with(tmp_path, **options)


# ------------------------------------------------------------------------------------------------ the scale

SWITCH = {"endstop_pin": "PC7", "position_endstop": 5}
TOUCH_Z = bed_height(SHAPE, 0, 0)
STATUS = "[gcode_macro SEE]\ngcode:\n  {% set s = printer[params.OF] %}\n  M118 {s}\n"


def test_it_is_calibrated_by_a_weight(tmp_path: Path) -> None:
    """The weight is the nozzle pressed into the bed: 0.1 mm at 4 kg/mm."""
    cell = LoadCellSettings(counts_per_gram=87.5, zero=-12_000)
    stage = stage_with(
        tmp_path, cell=cell, z=SWITCH, counts_per_gram=None, reference_tare_counts=None, sections=STATUS
    )
    output = stage.do(
        *("G28", "LOAD_CELL_READ", "LOAD_CELL_CALIBRATE", "TARE", f"G1 Z{TOUCH_Z - 0.1:.4f} F600", "M400"),
        *("CALIBRATE GRAMS=400", "ACCEPT", "LOAD_CELL_READ", f"G1 Z{TOUCH_Z - 0.05:.4f}", "LOAD_CELL_READ"),
        *("LOAD_CELL_TARE", "LOAD_CELL_READ", f"G1 Z{TOUCH_Z - 0.1:.4f}", "LOAD_CELL_READ", "M400", "G4 S2"),
        "SEE OF=load_cell_probe",
    )
    assert "load_cell_probe: not calibrated; -12000 counts" in output
    read = [
        float(re.split("[: ]+", text)[1]) for text in output if re.match("load_cell_probe: [-0-9.]+ g;", text)
    ]
    per_step = 4000 * MICROSTEP_MM
    assert read == pytest.approx([400, 200, 0, 200], abs=2 * per_step)
    assert stage.machine is not None
    saved = stage.machine.unsaved.pending[KIND]
    assert float(saved["counts_per_gram"]) == pytest.approx(87.5, rel=per_step / 400)
    assert saved["reference_tare_counts"] == "-12000"
    status = ast.literal_eval(output[-1].removeprefix("echo: "))
    assert status["is_calibrated"]
    assert status["force_g"] == pytest.approx(200, abs=2 * per_step)
    assert status["min_force_g"] <= status["force_g"] <= status["max_force_g"]
    assert status["counts_per_gram"] == pytest.approx(87.5, rel=per_step / 400)
    assert status["reference_tare_counts"] == -12_000
    assert status["tare_counts"] == pytest.approx(-12_000 + 200 * 87.5, abs=90 * per_step)
    assert (status["errors"], status["overflows"], status["sample_rate"]) == (0, 0, 80)
    assert not status["is_last_tap_valid"]


@pytest.mark.parametrize(
    ("lines", "why"),
    [
        (("TARE",), "TARE is for a calibration; begin with LOAD_CELL_CALIBRATE"),
        (("LOAD_CELL_CALIBRATE", "CALIBRATE GRAMS=400"), "CALIBRATE comes after TARE"),
        (("LOAD_CELL_CALIBRATE", "CALIBRATE"), "CALIBRATE needs GRAMS="),
        (("LOAD_CELL_CALIBRATE", "ACCEPT"), "ACCEPT comes after TARE and CALIBRATE"),
        (("LOAD_CELL_CALIBRATE", "LOAD_CELL_CALIBRATE"), "ACCEPT or ABORT that"),
        (("LOAD_CELL_CALIBRATE", "ABORT", "ACCEPT"), "ACCEPT is for"),
        (
            ("LOAD_CELL_CALIBRATE", "TARE", "CALIBRATE GRAMS=500", "ACCEPT"),
            "the weight changed readings by 0 counts, and 100 are needed",
        ),
        (("LOAD_CELL_READ LOAD_CELL=other",), "there is load_cell_probe"),
    ],
)
def test_a_calibration_that_makes_no_sense_is_refused(
    tmp_path: Path, lines: tuple[str, ...], why: str
) -> None:
    stage = stage_with(tmp_path, cell=LoadCellSettings(), z=SWITCH)
    with pytest.raises(GCodeError, match=re.escape(why)):
        stage.do(*lines)
    assert stage.machine is not None
    assert KIND not in stage.machine.unsaved.pending


@pytest.mark.parametrize(("gain", "share"), [("A-128", 1), ("A-64", 0.5), ("B-64", 0), ("B-8", 0)])
def test_a_gain_is_set(tmp_path: Path, gain: str, share: float) -> None:
    """Channel B is not connected."""
    stage = stage_with(tmp_path, cell=LoadCellSettings(), z=SWITCH, sensor_type="hx717", gain=gain)
    (output,) = stage.do("LOAD_CELL_READ")
    assert output.endswith(f"; {ZERO * share:.0f} counts")


def test_a_diagnostic_tells_what_the_sensor_does(tmp_path: Path) -> None:
    stage = stage_with(tmp_path, cell=LoadCellSettings(noise=50, rate=0.96), z=SWITCH)
    output = " ".join(stage.do("LOAD_CELL_DIAGNOSTIC"))
    (rate,) = map(float, re.findall(r"([0-9.]+) per second \(sample_rate 80\)", output))
    (spread,) = map(float, re.findall(r"standard deviation ([0-9.]+) force", output))
    (grams,) = map(float, re.findall(r"standard deviation ([0-9.]+) g", output))
    assert rate == pytest.approx(0.96 * 80, rel=0.01)
    assert spread == pytest.approx(50, rel=0.15)
    assert grams == pytest.approx(0.5, rel=0.15)
    assert "errors since the start: 0" in output


def test_taps_by_hand_are_felt(tmp_path: Path) -> None:
    """The hum taps: each two seconds with 100 g."""
    tapping = LoadCellSettings(hum=100, hum_hz=0.5)
    output = stage_with(tmp_path, cell=tapping, z=SWITCH).do("LOAD_CELL_TEST_TAP TAPS=2 TIMEOUT=4")
    assert output[-2:] == ["tap 2 of 2", "all taps were felt: the nozzle is ready to probe"]
    weak = stage_with(tmp_path / "weak", cell=LoadCellSettings(), z=SWITCH)
    with pytest.raises(GCodeError, match="tap 1 of 2 was not felt within 4 s"):
        weak.do("LOAD_CELL_TEST_TAP TAPS=2 TIMEOUT=4")


def test_scales_without_a_probe(tmp_path: Path) -> None:
    wiring = {"sensor_type": "hx711", "counts_per_gram": 100, "reference_tare_counts": ZERO}
    sections = (
        section("load_cell", **wiring, dout_pin="toolhead:PC5", sclk_pin="toolhead:PC6")
        + section(
            "load_cell spool", dout_pin="toolhead:PC7", sclk_pin="toolhead:PB1", sample_rate=10, **wiring
        )
        + STATUS
    )
    text = machine_text(kind="probe", pin="^toolhead:PC3", z=SWITCH, sections=sections)
    stage = ProbeStage(tmp_path, text, bed=BedSettings(load_cell=LoadCellSettings(drift=1)))
    output = stage.do(
        "G4 S20", "LOAD_CELL_READ LOAD_CELL=load_cell", "LOAD_CELL_READ LOAD_CELL=spool", "SEE OF=load_cell"
    )
    first, second = (float(re.split("[: ]+", text)[-4]) for text in output[:2])
    assert 20 < first < second < 40
    assert ast.literal_eval(output[-1].removeprefix("echo: "))["force_g"] == pytest.approx(second + 1, abs=3)
    again = ProbeStage(tmp_path, text)
    with pytest.raises(GCodeError, match="LOAD_CELL_READ needs LOAD_CELL=; there are load_cell, spool"):
        again.do("LOAD_CELL_READ")


def test_the_status_has_the_documented_fields(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "gcode.md").read_text(encoding="utf-8")
    (cell,) = re.findall(r"^\| `load_cell NAME` \| (.*) \|$", page, re.MULTILINE)
    (probe,) = re.findall(r"^\| `load_cell_probe` \| those of `load_cell`, (.*) \|$", page, re.MULTILINE)
    documented = {text.strip() for text in re.sub(r"\([^)]*\)", "", f"{cell}, {probe}").split(",")}
    output = stage_with(tmp_path, z=SWITCH, sections=STATUS).do("SEE OF=load_cell_probe", "SEE OF=probe")
    shown, common = (ast.literal_eval(text.removeprefix("echo: ")) for text in output)
    assert set(shown) == documented
    assert common["name"] == KIND


def test_the_last_tap_is_shown(tmp_path: Path) -> None:
    stage = stage_with(tmp_path, speed=2, sections=STATUS)
    output = stage.do("G28", "G1 X30 Y50 Z1 F6000", "PROBE", "SEE OF=load_cell_probe")
    shown = ast.literal_eval(output[-1].removeprefix("echo: "))
    assert shown["is_last_tap_valid"]
    assert shown["last_z_result"] == pytest.approx(heights(output)[0], abs=1e-6)
    assert shown["endstop_tare_counts"] == pytest.approx(ZERO, abs=100)
    assert 0 < shown["last_trigger_time"] < 120


def test_a_scale_weighs_again_when_its_node_is_back(tmp_path: Path) -> None:
    wiring = {"sensor_type": "hx711", "counts_per_gram": 100, "reference_tare_counts": ZERO}
    sections = (
        section("mcu scale", canbus_uuid="010203040506", canbus_interface="can0", policy="optional")
        + section("load_cell", dout_pin="scale:PC5", sclk_pin="scale:PC6", **wiring)
        + STATUS
    )
    text = machine_text(kind="probe", pin="^toolhead:PC3", z=SWITCH, sections=sections)
    stage = ProbeStage(tmp_path, text, bed=BedSettings(load_cell=LoadCellSettings(drift=1)))
    stage.on_echo["off"] = stage.node("scale").power_off
    stage.on_echo["on"] = stage.node("scale").power_on
    output = stage.do(
        *("G4 S9", "M400", "SEE OF=load_cell", "M118 off", "G4 S5", "M400", "SEE OF=load_cell"),
        *("M118 on", "G4 S9", "M400", "SEE OF=load_cell", "LOAD_CELL_READ"),
    )
    found = [ast.literal_eval(text[6:])["force_g"] for text in output if text.startswith("echo: {")]
    assert found[0] > 5
    assert found[1] is None, "what was long ago is no force of now"
    assert found[2] > found[0] + 10
    assert output[-1].startswith("load_cell: ")


def test_a_force_that_is_not_measured_any_more_is_not_shown(tmp_path: Path) -> None:
    stage = stage_with(tmp_path, z=SWITCH, sections=STATUS)
    stage.on_echo["dead"] = lambda: fault(stage, PlantFault.DEAD)
    output = stage.do(
        *("G4 S2", "M400", "SEE OF=load_cell_probe", "M118 dead", "G4 S4", "M400"), "SEE OF=load_cell_probe"
    )
    found = [ast.literal_eval(text[6:])["force_g"] for text in output if text.startswith("echo: {")]
    assert found == [pytest.approx(0, abs=1), None]


# ------------------------------------------------------------------------------------------------- options


@pytest.mark.parametrize(
    ("options", "sections"),
    [
        ({}, []),
        ({"drift_filter_cutoff_frequency": 0.8}, [high_pass(0.8, 320, 2)]),
        (
            {"drift_filter_cutoff_frequency": 0.8, "drift_filter_delay": 1},
            [high_pass(0.8, 320, 1)],
        ),
        ({"buzz_filter_cutoff_frequency": 100}, [low_pass(100, 320, 2)]),
        ({"buzz_filter_cutoff_frequency": 100, "buzz_filter_delay": 1}, [low_pass(100, 320, 1)]),
        ({"notch_filter_frequencies": "50, 60"}, [notch(50, 320, 2), notch(60, 320, 2)]),
        ({"notch_filter_frequencies": "50", "notch_filter_quality": 3}, [notch(50, 320, 3)]),
    ],
)
def test_the_filter_is_as_configured(
    tmp_path: Path, options: dict[str, Any], sections: list[Section]
) -> None:
    stage = stage_with(tmp_path, sensor_type="hx717", **options)
    (probe,) = build_modules(stage.description).of(LoadCellProbe)
    assert probe.cell.sensor.trigger is not None
    assert list(probe.cell.sensor.trigger.sections) == sections


def homing_s(stage: ProbeStage) -> float:
    """Return how long a G28 takes, s."""
    at: list[float] = []
    for name in ("begin", "end"):
        stage.on_echo[name] = lambda: at.append(stage.stage.now_ns() * 1e-9)
    stage.do("G28 X Y", "M400", "M118 begin", "G28 Z", "M118 end")
    begin, end = at
    return end - begin


@pytest.mark.parametrize(
    ("options", "more_s"), [({"pullback_speed": 0.02}, 7.5), ({"tare_time": 2}, 2 * (2 - 0.067))]
)
def test_what_takes_time_takes_as_long_as_configured(
    tmp_path: Path, options: dict[str, Any], more_s: float
) -> None:
    usual_s = homing_s(stage_with(tmp_path))
    assert homing_s(stage_with(tmp_path / "own", **options)) == pytest.approx(usual_s + more_s, abs=0.5)

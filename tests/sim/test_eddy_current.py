"""[probe_eddy_current] on a virtual bed in virtual time, by the node's firmware and a chip on an I2C bus.

The reference clock of the chip is off by 0.02 %, as a crystal may be, and the calibration has that in it.
Where the calibration is not what is tested it is computed by the formula of docs/plant.md.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.config.errors import ConfigError
from coordinator.gcode.errors import GCodeError
from coordinator.modules.eddy_current.eddy_probe import EddyProbe
from coordinator.runtime.machine import Machine
from coordinator.virtual_machine.plant_bed import BedSettings
from nodes.devices.ldc1612 import Ldc1612
from nodes.virtual.plant import Bed
from nodes.virtual.plant_page import PlantFault, PlantItemKind
from tests.profiles import is_full
from tests.stages.printer_text import section
from tests.stages.probe_stage import MICROSTEP_MM, OFFSET, ProbeStage, bed_height, heights, machine_text

CLOCK = 1.0002
SHAPE = Bed(z=0.2, x0=100, y0=100, tilt_x=0.002, tilt_y=-0.001, bow=0.3, radius=120)
BED = BedSettings(shape=SHAPE, coil_clock=CLOCK)
KIND = "probe_eddy_current coil"
RUNS = 50 if is_full() else 2
DESCEND_MM = 0.5
MESH = section(
    "bed_mesh", mesh_min="30, 30", mesh_max="180, 170", probe_count="5, 4", speed=150, horizontal_move_z=2
)


def frequency(height_mm: float) -> float:
    """Return what the host takes for the frequency of the coil at a height, Hz."""
    return 3e6 * (1 + 0.1 * math.exp(-height_mm / 3)) / CLOCK


TABLE = ",\n  ".join(f"{mm / 20:g}:{frequency(mm / 20):.3f}" for mm in range(1, 81))


def stage_with(folder: Path, *, bed: BedSettings = BED, sections: str = "", **options: Any) -> ProbeStage:
    given = {"kind": KIND, "calibrate": TABLE} | options
    return ProbeStage(folder, machine_text(sections=sections, **given), bed=bed)


def coil_height(x: float, y: float) -> float:
    """Return the height of the bed below the coil, the nozzle being at X, Y."""
    return bed_height(SHAPE, x + OFFSET[0], y + OFFSET[1])


def zero_error(stage: ProbeStage) -> float:
    """Return how far off the zero of Z is that G28 found at X 0, Y 0, mm."""
    assert stage.machine is not None
    counts = {name: motor.count for name, motor in stage.page("mcu").motors.items()}
    positions = stage.machine.stepper_positions
    head = positions.head(positions.positions(counts))
    assert head is not None
    return head[2] - (stage.true_mm("z") - coil_height(0, 0))


# -------------------------------------------------------------------------------------------- what it finds


def test_a_calibration_by_hand_recovers_the_height(tmp_path: Path) -> None:
    """With nothing known before: Z homes by a switch, and the drive current is found, too."""
    switch = {"endstop_pin": "PC7", "position_endstop": 5}
    stage = stage_with(tmp_path, z=switch, calibrate=None, reg_drive_current=None, intb_pin="toolhead:PC6")
    touch_z = bed_height(SHAPE, 100, 100)
    output = stage.do(
        *("G28", "G1 X100 Y100 Z1 F6000", "LDC_CALIBRATE_DRIVE_CURRENT CHIP=coil"),
        *("PROBE_EDDY_CURRENT_CALIBRATE CHIP=coil", f"TESTZ Z={touch_z - 1:.4f}", "ACCEPT"),
        *("G1 Z3 F600", "QUERY_PROBE", "PROBE", "QUERY_PROBE", "G1 Z3", "G1 X30 Y50 F6000", "PROBE", "G1 Z3"),
        *("G1 X150 Y20", "PROBE SAMPLES=3"),
    )
    found = np.array(heights(output)) - DESCEND_MM
    exact = [coil_height(80, 90), coil_height(30, 50), *[coil_height(150, 20)] * 3]
    # Z by the switch and the paper are a microstep exact each, and so are all heights that follow.
    assert np.ptp(found - exact) < 0.001, found - exact
    assert found == pytest.approx(exact, abs=2 * MICROSTEP_MM)
    assert output.index("probe: open") < output.index("probe: TRIGGERED")
    assert stage.machine is not None
    saved = stage.machine.unsaved.pending[KIND]
    assert saved["reg_drive_current"] == "15"
    pairs = [tuple(map(float, pair.split(":"))) for pair in saved["calibrate"].replace("\n", "").split(",")]
    assert [hz for _, hz in pairs] == pytest.approx([frequency(mm) for mm, _ in pairs], rel=2e-5)
    assert pairs[0][0] == pytest.approx(0.05, abs=MICROSTEP_MM)


def test_homing_finds_the_same_place_with_any_clocks_lost_frames_and_noise(tmp_path: Path) -> None:
    noisy = BedSettings(shape=SHAPE, coil_clock=CLOCK, coil_noise_hz=30)
    errors = []
    for seed in range(RUNS):
        stage = ProbeStage(
            tmp_path,
            machine_text(kind=KIND, calibrate=TABLE),
            seed=seed,
            loss=0.01,
            bed=noisy,
            start=(0.0, 0.0, 3.5 + 0.37 * seed % 3),
        )
        stage.do("G28")
        errors.append(zero_error(stage))
    assert max(map(abs, errors)) < MICROSTEP_MM, errors
    assert np.ptp(errors) < MICROSTEP_MM, errors


def test_scans_find_the_bed_standing_and_in_flight(tmp_path: Path) -> None:
    stage = stage_with(tmp_path, sections=MESH)
    began: list[float] = []
    stage.on_echo["fly"] = lambda: began.append(stage.stage.now_ns() * 1e-9)
    stage.on_echo["landed"] = lambda: began.append(stage.stage.now_ns() * 1e-9)
    output = stage.do(
        *("G28", "BED_MESH_CALIBRATE METHOD=scan", "BED_MESH_MAP", "BED_MESH_CLEAR", "G1 X30 Y20 Z2 F9000"),
        *("M400", "M118 fly", "BED_MESH_CALIBRATE METHOD=rapid_scan", "M118 landed", "BED_MESH_MAP"),
    )
    maps = [text.removeprefix("mesh_map_output") for text in output if text.startswith("mesh_map_output")]
    grid = [[(x, y) for x in np.linspace(30, 180, 5)] for y in np.linspace(30, 170, 4)]
    exact = np.array([[bed_height(SHAPE, x, y) for x, y in row] for row in grid])
    zero = stage.true_mm("z") - 2  # what G28 took for 0, by less than a microstep
    for text in maps:
        found = np.array(json.loads(text)["z_positions"])
        assert found == pytest.approx(exact - coil_height(0, 0), abs=0.005)
        assert np.std(found - exact) < 0.001
    assert zero == pytest.approx(coil_height(0, 0), abs=2 * MICROSTEP_MM)
    motors = (("PB0", "PB1"), ("PB3", "PB4"))
    flight = np.sort(np.concatenate([stage.steps(*pins, "mcu")[0] for pins in motors]))
    flight = flight[(flight > began[0] + 0.6) & (flight < flight[-1])]
    assert np.diff(flight).max() < 0.02, "the head never stood at a place"


def test_the_bus_the_chip_and_the_height_are_as_configured(tmp_path: Path) -> None:
    """The plant has the same chip there, and nothing elsewhere; the clock of 40 MHz needs no division."""
    bus: dict[str, Any] = {"i2c_bus": "i2c2", "i2c_address": 43, "i2c_speed": 100000}
    chip: dict[str, Any] = {"frequency": 40000000, "max_sensor_hz": 9000000, "intb_pin": "toolhead:PC6"}
    stage = stage_with(tmp_path, **bus, **chip, z_offset=0.8)
    output = stage.do("G28", "QUERY_PROBE")
    assert output == ["probe: TRIGGERED"]
    assert abs(zero_error(stage)) < MICROSTEP_MM
    assert stage.true_mm("z") - coil_height(0, 0) == pytest.approx(0.8, abs=0.06)


# ----------------------------------------------------------------------------------------------- what fails


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"i2c_mcu": "hotend"}, "there is no node of that name; add [mcu hotend]"),
        ({"intb_pin": "PC6"}, "it has to be one of node toolhead, as the bus is"),
        ({"descend_z": 0.4, "z_offset": 0.4}, "descend_z and z_offset mean the same; remove z_offset"),
        ({"z_offset": -0.1}, "the nozzle must not touch the bed; it must be above 0"),
        ({"calibrate": "0.1:3000, 0.2:3100, 0.3:2900, 0.4:2800"}, "as saved by a calibration"),
        ({"sensor_type": "ldc1614"}, "ldc1612"),
    ],
)
def test_options_that_cannot_be_are_refused(tmp_path: Path, options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ConfigError) as refused:
        stage_with(tmp_path, **options)
    assert sentence in str(refused.value)


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("Z_OFFSET_APPLY_PROBE", "come from PROBE_EDDY_CURRENT_CALIBRATE: calibrate again"),
        ("PROBE_CALIBRATE", "come from PROBE_EDDY_CURRENT_CALIBRATE: calibrate again"),
        ("LDC_CALIBRATE_DRIVE_CURRENT CHIP=other", "CHIP of LDC_CALIBRATE_DRIVE_CURRENT is 'other'"),
        ("PROBE_EDDY_CURRENT_CALIBRATE", "PROBE_EDDY_CURRENT_CALIBRATE comes before Z is homed"),
    ],
)
def test_commands_that_do_not_fit_are_refused(tmp_path: Path, line: str, sentence: str) -> None:
    assert sentence in failure(stage_with(tmp_path), line)


def failure(stage: ProbeStage, *lines: str) -> str:
    with pytest.raises(Exception) as raised:  # noqa: PT011 - whatever it is, its sentence is tested
        stage.do(*lines)
    return str(raised.value)


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        (PlantFault.OPEN, "the sensor does not answer on its I2C bus: check its wiring"),
        (PlantFault.DEAD, "the sensor makes no readings: check its supply and its reference clock"),
        (PlantFault.SHORTED, "the sensor flags its readings as bad: check its coil"),
    ],
)
def test_a_sensor_that_fails_on_the_way_down_stops_the_head_at_once(
    tmp_path: Path, fault: PlantFault, sentence: str
) -> None:
    stage = stage_with(tmp_path)

    def fail() -> None:
        stage.page("toolhead").set_fault(PlantItemKind.COIL, "probe", fault)

    stage.when(lambda: stage.true_mm("z") > 9.9, lambda: stage.when(lambda: stage.true_mm("z") < 8, fail))
    said = failure(stage, "G28", "G1 Z10 F1200", "PROBE PROBE_SPEED=5")
    assert "PROBE failed: " in said
    assert sentence in said
    # Ten looks of 2 ms without a reading, a trigger on the bus, and less than a millimetre in all.
    assert 7.7 < stage.true_mm("z") < 8
    reached = float(said.rpartition("Z is ")[2].split()[0])
    assert reached == pytest.approx(stage.true_mm("z") - coil_height(0, 0), abs=0.005)


@pytest.mark.parametrize("node", ["toolhead", "mcu"] if is_full() else ["toolhead"])
def test_a_node_that_is_lost_stops_the_head(tmp_path: Path, node: str) -> None:
    stage = stage_with(tmp_path)
    stage.when(
        lambda: stage.true_mm("z") > 9.9,
        lambda: stage.when(lambda: stage.true_mm("z") < 8, lambda: stage.stage.cut(node)),
    )
    said = failure(stage, "G28", "G1 Z10 F1200", "PROBE PROBE_SPEED=4")
    assert f"lost node {node}" in said
    (notice,) = [text for text in stage.output if text.startswith("the machine stopped while")]
    assert float(notice.rpartition("Z is ")[2].split()[0]) < stage.true_mm("z")
    assert stage.true_mm("z") > 6.5, "a node that hears nothing stops after a quarter of a second: 1 mm"


def test_a_sensor_that_fails_in_flight_ends_the_scan(tmp_path: Path) -> None:
    stage = stage_with(tmp_path, sections=MESH)
    stage.when(
        lambda: stage.true_mm("probe_y") > 60,
        lambda: stage.page("toolhead").set_fault(PlantItemKind.COIL, "probe", PlantFault.DEAD),
    )
    said = failure(stage, "G28", "BED_MESH_CALIBRATE METHOD=rapid_scan")
    assert "BED_MESH_CALIBRATE failed: [probe_eddy_current coil]: the sensor makes no readings" in said
    assert said.endswith("Z is 2.000 mm")


def test_a_scan_that_ends_early_ends_its_readings(tmp_path: Path) -> None:
    """The last place of a row is out of reach, which is found on the way."""
    mesh = MESH.replace("180, 170", "230, 170")
    stage = stage_with(tmp_path, sections=mesh)
    sensors: list[Ldc1612] = []

    def ready(machine: Machine) -> None:
        sensors.extend(probe.sensor for probe in machine.modules.of(EddyProbe))

    with pytest.raises(GCodeError, match="the move goes to X 210 mm"):
        stage.do("G28", "BED_MESH_CALIBRATE METHOD=rapid_scan", on_ready=ready)
    (sensor,) = sensors
    assert sensor.readings, "it had begun"
    assert not sensor.is_sampling


def test_frequencies_beyond_the_calibration_are_refused(tmp_path: Path) -> None:
    stage = stage_with(tmp_path, sections=MESH)
    said = failure(stage, "G28", "BED_MESH_CALIBRATE METHOD=scan HORIZONTAL_MOVE_Z=4.3")
    assert "Hz, which is below its calibrated range: the nozzle is more than 4.00 mm above the bed" in said
    assert said.endswith("Z is 4.300 mm")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"calibrate": None}, "is not calibrated: calibrate with PROBE_EDDY_CURRENT_CALIBRATE CHIP=coil"),
        ({"reg_drive_current": None}, "its drive current is not known: hold the head 20 mm above the bed"),
        ({"reg_drive_current": 5}, "the sensor flags its readings as bad"),
    ],
)
def test_nothing_moves_before_it_is_calibrated(
    tmp_path: Path, options: dict[str, Any], sentence: str
) -> None:
    stage = stage_with(tmp_path, **options)
    assert sentence in failure(stage, "G28")
    assert stage.true_mm("z") == 8

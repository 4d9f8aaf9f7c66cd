"""[z_tilt], [z_tilt_ng], [quad_gantry_level] on a frame whose motors begin 3 mm off above a virtual bed.

The truth is the plane through the heights at which the motors truly carry the frame.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.config.errors import ConfigError
from coordinator.virtual_machine.plant_bed import BedSettings
from nodes.virtual.plant import Bed
from nodes.virtual.plant_page import PlantFault
from tests.stages.printer_text import section
from tests.stages.probe_stage import OFFSET, ProbeStage, bed_height, heights, machine_text
from tests.stages.served import Served, running

START = (0.0, 0.0, 12.0)
THREE = {"stepper_z": (-20.0, 100.0), "stepper_z1": (220.0, 0.0), "stepper_z2": (220.0, 200.0)}
FOUR = {
    "stepper_z": (-10.0, -10.0),
    "stepper_z1": (-10.0, 210.0),
    "stepper_z2": (210.0, 210.0),
    "stepper_z3": (210.0, -10.0),
}
TILTED = Bed(z=0.2, x0=100, y0=100, tilt_x=0.002, tilt_y=-0.001)
POINTS = {
    "z_tilt": "10, 90\n  170, 10\n  170, 180",
    "z_tilt_ng": "10, 90\n  170, 10\n  170, 180",
    "quad_gantry_level": "5, 5\n  5, 180\n  175, 180\n  175, 5",
}


def places(supports: Mapping[str, tuple[float, float]]) -> str:
    return "\n  ".join(f"{x:g}, {y:g}" for x, y in supports.values())


def levelling(kind: str, **options: Any) -> str:
    """Return the section KIND with OPTIONS."""
    own: dict[str, Any] = {"points": f"\n  {POINTS[kind]}", "horizontal_move_z": 7, "speed": 150}
    if kind.startswith("z_tilt"):
        own["z_positions"] = f"\n  {places(THREE)}"
    else:
        own["gantry_corners"] = "\n  -10, -10\n  210, 210"
    own |= {"retries": 3, "retry_tolerance": 0.005} | options
    return section(kind, **{name: value for name, value in own.items() if value is not None})


def make(
    folder: Path,
    kind: str,
    raised: Mapping[str, float],
    *,
    shape: Bed = TILTED,
    noise_mm: float = 0.0,
    **options: Any,
) -> ProbeStage:
    supports = THREE if kind.startswith("z_tilt") else FOUR
    bed = BedSettings(shape=shape, supports=supports, raised_mm=raised, noise_mm=noise_mm)
    text = machine_text(further_z=len(supports) - 1, sections=levelling(kind, **options))
    return ProbeStage(folder, text, bed=bed, start=START)


def frame(stage: ProbeStage) -> tuple[float, float, float]:
    """Return the true height of the frame at x = y = 0 and its slopes, by the motors' steps."""
    motors = stage.page("mcu").motors
    supports = stage.bed.supports
    matrix = np.array([(1.0, *place) for place in supports.values()])
    at = [START[2] + stage.bed.raised_mm.get(n, 0.0) + motors[n].count * 8 / 200 / 16 for n in supports]
    z, slope_x, slope_y = np.linalg.lstsq(matrix, np.array(at), rcond=None)[0]
    return float(z), float(slope_x), float(slope_y)


def gap_over_bed(stage: ProbeStage) -> float:
    """Return how much the distance between the frame and the bed differs over the bed, mm."""
    z, slope_x, slope_y = frame(stage)
    gaps = [
        z + slope_x * x + slope_y * y - bed_height(stage.bed.shape, x, y)
        for x in (0.0, 100.0, 200.0)
        for y in (0.0, 100.0, 200.0)
    ]
    return float(np.ptp(gaps))


def passes(output: list[str]) -> int:
    return len([text for text in output if re.match(r"pass \d+: ", text)])


@pytest.mark.parametrize(
    ("kind", "command", "raised"),
    [
        ("z_tilt", "Z_TILT_ADJUST", {"stepper_z1": 1.5, "stepper_z2": -1.5}),
        ("z_tilt", "Z_TILT_ADJUST", {"stepper_z": -3.0}),
        ("z_tilt_ng", "Z_TILT_ADJUST", {"stepper_z1": 1.5, "stepper_z2": -1.5}),
        ("quad_gantry_level", "QUAD_GANTRY_LEVEL", {"stepper_z": -1.5, "stepper_z2": 1.5, "stepper_z3": 1.0}),
    ],
)
def test_a_frame_3_mm_off_is_level_after_few_passes(
    tmp_path: Path, kind: str, command: str, raised: Mapping[str, float]
) -> None:
    stage = make(tmp_path, kind, raised)
    output = stage.do(
        "G28", "G1 Z9 F600", command, "G1 X60 Y30 F6000", "PROBE", "G1 Z5", "G1 X150 Y150", "PROBE"
    )
    assert passes(output) <= 4, output
    assert gap_over_bed(stage) < 0.01
    # The probe is the endstop of Z: the bed is at 0 then, without another G28.
    assert heights(output)[-2:] == pytest.approx([OFFSET[2]] * 2, abs=0.006)


def test_a_bowed_bed_is_levelled_as_a_whole(tmp_path: Path) -> None:
    bowed = Bed(x0=100, y0=100, bow=0.2, radius=150)
    stage = make(tmp_path, "z_tilt", {"stepper_z1": 1.0}, shape=bowed, retry_tolerance=0.2)
    stage.do("G28", "G1 Z9 F600", "Z_TILT_ADJUST")
    measured = [
        (x + OFFSET[0], y + OFFSET[1], bed_height(bowed, x + OFFSET[0], y + OFFSET[1]))
        for x, y in ((10, 90), (170, 10), (170, 180))
    ]
    plane = np.linalg.solve(
        np.array([(1, x, y) for x, y, _ in measured]), np.array([z for *_, z in measured])
    )
    assert frame(stage)[1:] == pytest.approx(tuple(plane[1:]), abs=3e-5)


def test_with_a_switch_for_z_its_zero_stays(tmp_path: Path) -> None:
    """The frame's middle is not moved, and Z keeps its value."""
    bed = BedSettings(shape=TILTED, supports=THREE, raised_mm={"stepper_z1": 1.0, "stepper_z2": -1.0})
    switch = {"endstop_pin": "PC7", "position_endstop": 5}
    text = machine_text(z=switch, further_z=2, sections=levelling("z_tilt"))
    stage = ProbeStage(tmp_path, text, bed=bed, start=START)
    output = stage.do("G28", "G1 Z9 F600", "Z_TILT_ADJUST", "G1 Z8", "M114")
    assert gap_over_bed(stage) < 0.01
    z = float(output[-1].split("Z:")[1].split()[0])
    assert z == pytest.approx(stage.true_mm("z"), abs=0.01)


def test_it_is_levelled_by_hand(tmp_path: Path) -> None:
    """Somebody lowers the nozzle onto the bed at each place; the second pass finds it level."""
    bed = BedSettings(shape=TILTED, supports=THREE, raised_mm={"stepper_z1": 1.0, "stepper_z2": -1.0})
    switch = {"endstop_pin": "PC7", "position_endstop": 5}
    text = machine_text(z=switch, further_z=2, sections=levelling("z_tilt", retries=2))
    stage = ProbeStage(tmp_path, text, bed=bed, start=START)
    served = Served(tmp_path, lambda: stage.description, stage.host)

    async def run(script: str) -> list[str]:
        return list((await served.call("gcode.run", script=script))["replies"])

    async def main() -> None:
        async with running(served):
            begun = await run("G28\nG1 Z9 F600\nZ_TILT_ADJUST METHOD=manual")
            said, gaps = [begun], []
            for number in range(6):
                assert f"place {number % 3 + 1} of 3" in "".join(said[-1]), said
                x, y = served.planned[:2]
                z, slope_x, slope_y = frame(stage)
                gap = z + slope_x * x + slope_y * y - bed_height(TILTED, x, y)
                gaps.append(gap)
                said.append(await run(f"TESTZ Z={-gap:.4f}\nACCEPT"))
            assert passes(said[3]) == passes(said[6]) == 1
            assert np.ptp(gaps[:3]) > 1
            assert f"the heights are {np.ptp(gaps[:3]):.2f}" in said[3][1]
            assert served.tree.get("modules.z_tilt.applied") is True

    stage.run(main)
    assert gap_over_bed(stage) < 0.01


# ------------------------------------------------------------------------------------------------ z_tilt_ng

EXTRA = ((90.0, 20.0), (90.0, 160.0), (20.0, 20.0), (20.0, 170.0))
BOWED = Bed(x0=100, y0=100, tilt_x=0.001, bow=0.3, radius=150)


def unsaved(stage: ProbeStage) -> Mapping[str, str]:
    assert stage.machine is not None
    return stage.machine.unsaved.pending["z_tilt_ng"]


def numbers(text: str) -> np.ndarray:
    return np.array([[float(word) for word in line.split(",")] for line in text.strip().splitlines()])


def uneven_mm(points: Sequence[tuple[float, float]]) -> np.ndarray:
    """Return how far the bed at the first three POINTS of the nozzle is below the plane through all."""
    at = [(x + OFFSET[0], y + OFFSET[1]) for x, y in points]
    matrix = np.array([(1.0, x, y) for x, y in at])
    z = np.array([bed_height(BOWED, x, y) for x, y in at])
    return np.asarray((matrix @ np.linalg.lstsq(matrix, z, rcond=None)[0] - z)[:3])


def test_few_points_level_as_well_as_many(tmp_path: Path) -> None:
    extra = "\n  " + "\n  ".join(f"{x:g}, {y:g}" for x, y in EXTRA)
    stage = make(tmp_path, "z_tilt_ng", {}, shape=BOWED, extra_points=extra, noise_mm=0.004)
    output = stage.do("G28", "G1 Z9 F600", "Z_TILT_CALIBRATE AVGLEN=4", "Z_TILT_ADJUST RETRIES=0")
    points = [tuple(point) for point in numbers(POINTS["z_tilt_ng"])]
    wanted = uneven_mm([*points, *EXTRA])
    assert np.abs(wanted).max() > 0.02
    assert numbers(unsaved(stage)["z_offsets"])[0] == pytest.approx(wanted, abs=0.005)
    assert len([text for text in output if text.startswith("probe at")]) % 7 == 3
    # The frame follows the plane through all seven points now.
    at = np.array([(x + OFFSET[0], y + OFFSET[1]) for x, y in (*points, *EXTRA)])
    matrix = np.array([(1.0, x, y) for x, y in at])
    z = np.array([bed_height(BOWED, x, y) for x, y in at])
    slopes = np.linalg.lstsq(matrix, z, rcond=None)[0][1:]
    assert frame(stage)[1:] == pytest.approx(tuple(slopes), abs=6e-5)


def test_configured_offsets_count_for_the_spread_too(tmp_path: Path) -> None:
    level = Bed(x0=100, y0=100)
    stage = make(tmp_path, "z_tilt_ng", {}, shape=level, z_offsets="0.1, 0, 0", retries=0)
    output = stage.do("G28", "G1 Z9 F600", "Z_TILT_ADJUST")
    assert next(text for text in output if text.startswith("pass 1")).startswith(
        "pass 1: the heights are 0.10"
    )
    (tmp_path / "wrong").mkdir()
    with pytest.raises(ConfigError, match="2 heights, but there are 3 points"):
        make(tmp_path / "wrong", "z_tilt_ng", {}, z_offsets="0.1, 0")


@pytest.mark.parametrize("delta", ["", " DELTA=0.5"])
def test_the_motors_are_found(tmp_path: Path, delta: str) -> None:
    stage = make(tmp_path, "z_tilt_ng", {"stepper_z1": 1.0}, z_positions=None, autodetect_delta=2)
    output = stage.do("G28", "G1 Z9 F600", f"Z_TILT_AUTODETECT{delta}", "Z_TILT_ADJUST")
    by = delta.rpartition("=")[2] or "2"
    assert [text for text in output if "raised" in text] == [f"{name} is raised by {by} mm" for name in THREE]
    assert numbers(unsaved(stage)["z_positions"]) == pytest.approx(np.array(list(THREE.values())), abs=2.5)
    assert passes(output) <= 3
    assert gap_over_bed(stage) < 0.01


def test_a_motor_that_stays_raised_is_told(tmp_path: Path) -> None:
    """The probe fails while the second motor is raised."""
    stage = make(tmp_path, "z_tilt_ng", {}, z_positions=None, autodetect_delta=2)
    name = list(THREE)[1]
    stage.on_echo[f"{name} is raised by 2 mm"] = lambda: stage.fault(PlantFault.NEVER)
    said = failure(stage, "G28", "G1 Z9 F600", "Z_TILT_AUTODETECT")
    assert "did not trigger" in said
    assert said.endswith(f"; {name} is raised by 2 mm and stays so: level before you print")


def test_it_says_what_it_needs(tmp_path: Path) -> None:
    stage = make(tmp_path, "z_tilt_ng", {}, z_positions=None)
    said = failure(stage, "G28", "G1 Z9 F600", "Z_TILT_ADJUST")
    assert "Z_TILT_ADJUST needs z_positions of [z_tilt_ng]; Z_TILT_AUTODETECT finds them" in said
    assert "needs a probe" in failure(stage, "G28", "Z_TILT_CALIBRATE METHOD=manual")


# ------------------------------------------------------------------------------------------ options, status


def test_once_without_retries_and_as_often_as_the_command_says(tmp_path: Path) -> None:
    stage = make(tmp_path, "z_tilt", {"stepper_z1": 1.0}, retries=0, retry_tolerance=0)
    assert passes(stage.do("G28", "G1 Z9 F600", "Z_TILT_ADJUST")) == 1
    stage = make(tmp_path, "z_tilt", {"stepper_z1": 1.0}, retries=0)
    assert passes(stage.do("G28", "G1 Z9 F600", "Z_TILT_ADJUST RETRIES=2 RETRY_TOLERANCE=0.01")) == 2


def test_places_may_be_those_of_the_probe(tmp_path: Path) -> None:
    points = "\n  30, 100\n  190, 20\n  190, 190"
    stage = make(tmp_path, "z_tilt", {"stepper_z1": 1.0}, points=points, use_probe_xy_offsets=True, retries=0)
    output = stage.do("G28", "G1 Z9 F600", "Z_TILT_ADJUST")
    where = [text.split()[2] for text in output if text.startswith("probe at")]
    assert where[:3] == ["30.000,100.000", "190.000,20.000", "190.000,190.000"]


def test_the_head_travels_as_fast_as_configured(tmp_path: Path) -> None:
    """By the times of the steps of X: 80 a millimetre."""
    stage = make(tmp_path, "z_tilt", {"stepper_z1": 0.5}, speed=90, retries=0)
    stage.do("G28", "G1 Z9 F600", "Z_TILT_ADJUST")
    at = np.array([at for at, level in stage.edges("PB0", "mcu") if level])
    fastest_s = (at[40:] - at[:-40]).min() / 40
    assert 1 / (80 * fastest_s) == pytest.approx(90 * np.cos(np.arctan2(80, 160)), rel=0.02)


def test_the_head_travels_at_the_height_of_the_command(tmp_path: Path) -> None:
    stage = make(tmp_path, "z_tilt", {"stepper_z1": 0.5})
    output = stage.do("G28", "G1 Z9 F600", "Z_TILT_ADJUST HORIZONTAL_MOVE_Z=6", "M114")
    # The last lift is to 6; then Z is corrected by the mean of the heights.
    z = float(output[-1].split("Z:")[1].split()[0])
    assert z == pytest.approx(6, abs=0.02)


def test_the_head_may_travel_lower_after_the_first_pass(tmp_path: Path) -> None:
    """The heights are less than 2 mm apart, but the probe needs 2.5 mm."""
    options: dict[str, Any] = {"adaptive_horizontal_move_z": True, "min_horizontal_move_z": 2.5}
    stage = make(tmp_path, "z_tilt", {"stepper_z1": 1.5}, **options)
    z = stage.do("G28", "G1 Z9 F600", "Z_TILT_ADJUST", "M114")[-1].split("Z:")[1].split()[0]
    assert float(z) == pytest.approx(2.5, abs=0.02)


def test_macros_see_whether_it_was_done(tmp_path: Path) -> None:
    macro = "[gcode_macro SEE]\ngcode:\n  M118 {printer.z_tilt.applied}\n"
    text = machine_text(further_z=2, sections=levelling("z_tilt") + macro)
    text = text.replace("[stepper_z]\n", "[stepper_z]\nenable_pin: PF0\n")
    bed = BedSettings(supports=THREE, raised_mm={"stepper_z1": 0.5})
    stage = ProbeStage(tmp_path, text, bed=bed, start=START)
    output = stage.do("G28", "SEE", "G1 Z9 F600", "Z_TILT_ADJUST", "SEE", "M84", "SEE")
    assert [text for text in output if text.startswith("echo")] == [
        "echo: False",
        "echo: True",
        "echo: False",
    ]


# ------------------------------------------------------------------------------------------------- failures


def failure(stage: ProbeStage, *lines: str) -> str:
    with pytest.raises(Exception) as error:  # noqa: PT011 (whatever it is, its sentence counts)
        stage.do(*lines)
    return str(error.value)


def test_too_large_a_correction_is_refused_before_it_is_made(tmp_path: Path) -> None:
    stage = make(tmp_path, "quad_gantry_level", {"stepper_z2": 3.0, "stepper_z3": 3.0}, max_adjust=1)
    counts_before: dict[str, int] = {}
    said = failure(stage, "G28", "G1 Z9 F600", "QUAD_GANTRY_LEVEL")
    assert re.search(
        r"QUAD_GANTRY_LEVEL failed: a motor would have to move by 1\.\d+ mm, more than max_adjust", said
    )
    counts_before = {name: motor.count for name, motor in stage.page("mcu").motors.items() if "_z" in name}
    assert len(set(counts_before.values())) == 1, "the motors of Z moved together only"


def test_motors_in_the_wrong_order_are_noticed(tmp_path: Path) -> None:
    wrong = "\n  220, 0\n  -20, 100\n  220, 200"
    stage = make(tmp_path, "z_tilt", {"stepper_z1": 0.8}, z_positions=wrong)
    said = failure(stage, "G28", "G1 Z9 F600", "Z_TILT_ADJUST HORIZONTAL_MOVE_Z=9")
    assert "check that the motors are in the order of their places" in said


def test_a_probe_that_scatters_ends_it_after_the_last_pass(tmp_path: Path) -> None:
    stage = make(
        tmp_path, "z_tilt", {}, noise_mm=0.05, retry_tolerance=0.0001, increasing_threshold=1, retries=1
    )
    said = failure(stage, "G28", "G1 Z9 F600", "Z_TILT_ADJUST")
    assert re.search(
        r"the heights are 0\.\d+ mm apart after 2 passes, more than retry_tolerance \(0\.0001", said
    )


def test_it_needs_a_homed_machine(tmp_path: Path) -> None:
    stage = make(tmp_path, "z_tilt", {})
    assert "Z_TILT_ADJUST comes before Z is homed; home with G28 first" in failure(stage, "Z_TILT_ADJUST")

"""[axis_twist_compensation] where the axes lean the probe: the bed is flat, and so are heights afterwards."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.virtual_machine.plant_bed import BedSettings
from nodes.virtual.plant import Bed
from tests.profiles import is_full
from tests.stages.printer_text import section
from tests.stages.probe_stage import MICROSTEP_MM, OFFSET, ProbeStage, heights, machine_text

LEAN = {"X": 0.002, "Y": -0.001}
PLACES = {"X": (40, 100, 160), "Y": (30, 110, 190)}
OPTIONS: dict[str, Any] = {"speed": 200, "horizontal_move_z": 4, "calibrate_y": 60, "calibrate_x": 50}
OPTIONS |= {f"calibrate_start_{axis.lower()}": places[0] for axis, places in PLACES.items()}
OPTIONS |= {f"calibrate_end_{axis.lower()}": places[-1] for axis, places in PLACES.items()}


def stage_of(folder: Path, **options: Any) -> ProbeStage:
    text = machine_text(
        z={"homing_retract_dist": 0}, sections=section("axis_twist_compensation", **(OPTIONS | options))
    )
    bed = BedSettings(shape=Bed(z=0.2), lean_x=LEAN["X"], lean_y=LEAN["Y"])
    return ProbeStage(folder, text, bed=bed)


def leans(x: float, y: float) -> float:
    return LEAN["X"] * x + LEAN["Y"] * y


BED_Z = -leans(OFFSET[0], OFFSET[1])
"""Where the nozzle is at the bed, after G28 with the probe at its offset."""


def probes(*places: tuple[float, float]) -> list[str]:
    """Return the lines that probe with the probe at PLACES."""
    return [
        line
        for x, y in places
        for line in ("G1 Z3 F900", f"G1 X{x - OFFSET[0]} Y{y - OFFSET[1]} F9000", "PROBE")
    ]


@pytest.mark.parametrize("axis", ["X", "Y"] if is_full() else ["X"])
def test_what_the_nozzle_finds_by_hand_makes_the_probe_find_a_flat_bed(tmp_path: Path, axis: str) -> None:
    lines = ["G28", "G1 Z4 F900", f"AXIS_TWIST_COMPENSATION_CALIBRATE AXIS={axis} SAMPLE_COUNT=3"]
    lines += [f"TESTZ Z={BED_Z - OPTIONS['horizontal_move_z']}", "ACCEPT"] * 3
    along = [(at, 60.0) if axis == "X" else (50.0, at) for at in (30, 70, 130, 180)]
    stage = stage_of(tmp_path)
    output = stage.do(*lines, *probes(*along))
    before, found = heights(output)[:3], np.array(heights(output)[3:])
    assert np.ptp(before) > 0.1
    # Between the places the bed is flat; beyond them the compensation stays as it is there.
    beyond = [LEAN[axis] * min(0, at - PLACES[axis][0]) for at in (30, 70, 130, 180)]
    if axis == "X":
        beyond[3] = LEAN[axis] * 20
    assert found - beyond == pytest.approx([np.mean(before)] * 4, abs=2 * MICROSTEP_MM)
    assert stage.machine is not None
    saved = stage.machine.unsaved.pending["axis_twist_compensation"]
    name, letter = ("z_compensations", "x") if axis == "X" else ("zy_compensations", "y")
    step = LEAN[axis] * (PLACES[axis][1] - PLACES[axis][0])
    values = [float(word) for word in saved[name].split(",")]
    assert values == pytest.approx([step, 0, -step], abs=MICROSTEP_MM)
    assert saved[f"compensation_start_{letter}"] == f"{PLACES[axis][0]}"
    assert saved[f"compensation_end_{letter}"] == f"{PLACES[axis][-1]}"
    pin, turn = ("PB0", "PB1") if axis == "X" else ("PB3", "PB4")
    at, _ = stage.steps(pin, turn, "mcu")
    # The way from the place of the nozzle to that of the next probing leads along the other axis, too.
    assert 0.95 < 1 / np.diff(at).min() / 80 / OPTIONS["speed"] < 1.02


def test_saved_compensations_of_both_axes_act_after_a_start(tmp_path: Path) -> None:
    saved = {"z_compensations": "0.2, 0, -0.2", "compensation_start_x": 0, "compensation_end_x": 200}
    saved |= {"zy_compensations": "-0.1, 0.1", "compensation_start_y": 0, "compensation_end_y": 200}
    stage = stage_of(tmp_path, **saved)
    found = heights(stage.do("G28", *probes((40, 60), (150, 20), (90, 190))))
    assert np.ptp(found) < 2 * MICROSTEP_MM
    assert found[0] == pytest.approx(OFFSET[2] + BED_Z + 0.1, abs=2 * MICROSTEP_MM)


@pytest.mark.parametrize(
    ("options", "line", "said"),
    [
        ({}, "SAMPLE_COUNT=3", "AXIS_TWIST_COMPENSATION_CALIBRATE comes before Z is homed"),
        ({}, "AXIS=Z", "AXIS of AXIS_TWIST_COMPENSATION_CALIBRATE is 'Z'; X or Y is possible"),
        ({}, "AUTO=True", "AXIS_TWIST_COMPENSATION_CALIBRATE AUTO=1 is not supported"),
        (
            {"calibrate_end_x": 1},
            "",
            "of X needs calibrate_start_x, a higher calibrate_end_x and calibrate_y",
        ),
        ({"z_compensations": "0.1, 0.2"}, "", "needs compensation_start_x, and a higher compensation_end_x"),
        ({"z_compensations": "0.1"}, "", "2 to 100 heights in mm"),
    ],
)
def test_what_cannot_be_calibrated_is_refused(
    tmp_path: Path, options: dict[str, Any], line: str, said: str
) -> None:
    with pytest.raises(Exception, match=said):
        stage_of(tmp_path, **options).do(f"AXIS_TWIST_COMPENSATION_CALIBRATE {line}")

"""[probe] on a virtual bed in virtual time: what it finds is compared with the bed's formula.

The probe is on the tool head's node, the motors are on the other one.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.virtual_machine.plant_bed import BedSettings
from nodes.virtual.plant import Bed
from tests.profiles import is_full
from tests.stages.probe_stage import MICROSTEP_MM, OFFSET, ProbeStage, heights, machine_text

TILTED = BedSettings(shape=Bed(z=0.2, x0=100, y0=100, tilt_x=0.002, tilt_y=-0.001, bow=0.3, radius=120))
RUNS = 50 if is_full() else 6


def zero_error(stage: ProbeStage, x: float = 0.0, y: float = 0.0) -> float:
    """Return how far off the zero of Z is that G28 with the nozzle at X, Y found, mm."""
    assert stage.machine is not None
    counts = {name: motor.count for name, motor in stage.page("mcu").motors.items()}
    positions = stage.machine.stepper_positions
    head = positions.head(positions.positions(counts))
    assert head is not None
    return (head[2] - OFFSET[2]) - (stage.true_mm("z") - stage.trigger_z(x, y))


def test_homing_finds_the_same_place_with_any_clocks_and_lost_frames(tmp_path: Path) -> None:
    errors = []
    for seed in range(RUNS):
        stage = ProbeStage(
            tmp_path, seed=seed, loss=0.01, bed=TILTED, start=(0.0, 0.0, 6.0 + 0.37 * seed % 3)
        )
        stage.do("G28")
        errors.append(zero_error(stage))
    assert np.ptp(errors) < MICROSTEP_MM, errors
    # A step comes when half of it is due, and a look at the probe is 0.15 µm late at 3 mm/s.
    assert all(abs(error) < MICROSTEP_MM for error in errors), errors


def test_measured_heights_are_those_of_the_bed(tmp_path: Path) -> None:
    places = [(0, 0), (60, 30), (150, 20), (90, 160)]
    stage = ProbeStage(tmp_path, bed=TILTED)
    probes = [line for x, y in places for line in ("G1 Z6 F900", f"G1 X{x} Y{y} F6000", "PROBE")]
    output = stage.do("G28", *probes)
    found = np.array(heights(output)) - OFFSET[2]
    exact = np.array([stage.trigger_z(x, y) for x, y in places]) - stage.trigger_z(0, 0)
    assert found == pytest.approx(exact, abs=MICROSTEP_MM)
    told = [text for text in output if text.startswith("Result is")]
    assert f"at {90 + OFFSET[0]:.3f},{160 + OFFSET[1]:.3f}" in told[-1]


def test_the_probe_may_be_beside_a_switch_that_is_the_endstop_of_z(tmp_path: Path) -> None:
    text = machine_text(z={"endstop_pin": "PC7", "position_endstop": 5}, pin="^!PC5")
    stage = ProbeStage(tmp_path, text, bed=TILTED, start=(0.0, 0.0, 12.0))
    output = stage.do("G28", "G1 Z7 F600", "M119", "PROBE", "QUERY_PROBE", "G1 Z6 F600", "QUERY_PROBE")
    (found,) = heights(output)
    assert found == pytest.approx(stage.trigger_z(0, 0), abs=1.5 * MICROSTEP_MM)
    assert output[0].split() == ["z:open"]
    assert output[-2:] == ["probe: TRIGGERED", "probe: open"]


ONE_NODE = {"pin": "^PC5"}
SIDES = "step_pin: PD1\ndir_pin: PE1", "step_pin: toolhead:PD1\ndir_pin: toolhead:PE1"


@pytest.mark.parametrize(
    ("options", "further_z", "nodes"), [(ONE_NODE, 0, 1), (ONE_NODE, 1, 2), ({}, 1, 2), ({}, 0, 2)]
)
def test_probe_and_motors_may_be_on_any_nodes(
    tmp_path: Path, options: dict[str, Any], further_z: int, nodes: int
) -> None:
    """Also the two motors of Z on one node each."""
    text = machine_text(further_z=further_z, **options)
    assert further_z == text.count(SIDES[0])
    stage = ProbeStage(tmp_path, text.replace(*SIDES), bed=TILTED)
    at_work = {stage.probe_node, *(motor.node for motor in stage.description.rails[2].steppers)}
    assert len(at_work) == nodes
    output = stage.do("G28", "G1 Z5 F600", "G1 X60 Y30 F6000", "PROBE")
    exact = OFFSET[2] + stage.trigger_z(60, 30) - stage.trigger_z(0, 0)
    assert heights(output) == [pytest.approx(exact, abs=MICROSTEP_MM)]


# --------------------------------------------------------------------------------------------------- options


def measured(folder: Path, command: str = "PROBE", *, noise_mm: float = 0.0, **probe: Any) -> list[str]:
    """Return what COMMAND says at Z 6, of a probe with these options."""
    stage = ProbeStage(folder, machine_text(**probe), bed=BedSettings(noise_mm=noise_mm))
    return stage.do("G28", "G1 Z6 F900", command)


@pytest.mark.parametrize("result", ["average", "median"])
def test_samples_become_their_average_or_median(tmp_path: Path, result: str) -> None:
    output = measured(tmp_path, noise_mm=0.02, samples=5, samples_result=result, samples_tolerance=1)
    found = heights(output)
    assert len(found) == 5
    assert np.ptp(found) > 0.004
    exact = np.mean(found) if result == "average" else np.median(found)
    assert float(output[-1].split("z=")[1].split(":")[0]) == pytest.approx(exact, abs=1e-6)


def test_a_command_may_measure_otherwise_than_configured(tmp_path: Path) -> None:
    command = "PROBE SAMPLES=3 SAMPLES_RESULT=median SAMPLES_TOLERANCE=1 SAMPLE_RETRACT_DIST=1 PROBE_SPEED=2"
    assert len(heights(measured(tmp_path, command, noise_mm=0.02))) == 3
    with pytest.raises(Exception, match="SAMPLES_RESULT of PROBE is 'best'; average or median is possible"):
        measured(tmp_path, "PROBE SAMPLES_RESULT=best")


def test_the_first_result_may_be_dropped(tmp_path: Path) -> None:
    output = measured(tmp_path, noise_mm=0.02, samples=2, drop_first_result=True, samples_tolerance=1)
    found = heights(output)
    assert len(found) == 3
    assert float(output[-1].split("z=")[1].split(":")[0]) == pytest.approx(np.mean(found[1:]), abs=1e-6)
    assert "the first result is dropped" in output


def test_samples_too_far_apart_are_taken_again_and_then_refused(tmp_path: Path) -> None:
    options: dict[str, Any] = {"samples": 2, "samples_tolerance": 0.0005, "samples_tolerance_retries": 2}
    output: list[str] = []
    stage = ProbeStage(tmp_path, machine_text(**options), bed=BedSettings(noise_mm=0.05))
    stage.output = output
    with pytest.raises(Exception, match=r"PROBE failed: the samples are 0\.\d+ mm apart.*after 2 retries"):
        stage.do("G28", "G1 Z6 F900", "PROBE")
    assert len([text for text in output if "retry" in text]) == 2


def test_speeds_and_the_lift_are_as_configured(tmp_path: Path) -> None:
    """By the times of the motor's steps: 400 a millimetre."""
    text = machine_text(speed=2, lift_speed=10, samples=2, sample_retract_dist=1.5)
    stage = ProbeStage(tmp_path, text)
    stage.do("G28", "G1 Z2.5 F900", "M400", "PROBE")
    at, up = stage.steps("PB6", "PB7", "mcu")
    last_down = np.flatnonzero(up)[-1] + 1  # behind the lift between the samples
    lift = up[:last_down]
    lifted = last_down - np.flatnonzero(~lift)[-1] - 1
    assert lifted * MICROSTEP_MM == pytest.approx(1.5, abs=3 * MICROSTEP_MM)
    down_s = np.diff(at[last_down:]).min()
    assert MICROSTEP_MM / down_s == pytest.approx(2.0, rel=0.03)
    up_s = np.diff(at[last_down - lifted : last_down]).min()
    assert MICROSTEP_MM / up_s == pytest.approx(10.0, rel=0.03)


@pytest.mark.parametrize(("each", "times"), [(True, 3), (False, 1)])
def test_lines_make_it_ready_and_put_it_away(tmp_path: Path, each: bool, times: int) -> None:
    lines: dict[str, Any] = {"activate_gcode": "M118 out", "deactivate_gcode": "M118 in"}
    output = measured(tmp_path, "PROBE SAMPLES=3", deactivate_on_each_sample=each, **lines)
    told = [text for text in output if text.startswith("echo")]
    assert told == ["echo: out", "echo: in"] * (1 + times), "once around homing"


def test_lines_must_leave_the_head_where_it_is(tmp_path: Path) -> None:
    with pytest.raises(
        Exception, match=r"PROBE: the lines that activate or deactivate \[probe\] moved the head"
    ):
        measured(
            tmp_path, activate_gcode="{% if 'z' in printer.toolhead.homed_axes %}\n  G1 Z7\n  {% endif %}"
        )


def test_safe_z_home_runs_the_lines_around_z_alone(tmp_path: Path) -> None:
    lines: dict[str, Any] = {"activate_gcode": "M118 out\n  M114", "deactivate_gcode": "M118 in\n  M114"}
    safe = "[safe_z_home]\nhome_xy_position: 100, 90\nz_hop: 9\nmove_to_previous: True\n"
    stage = ProbeStage(tmp_path, machine_text(sections=safe, **lines), bed=TILTED)
    output = stage.do("G28", "M114")
    assert [text.split(" Z")[0] for text in output] == [
        *("echo: out", "X:100.000 Y:90.000", "echo: in", "X:100.000 Y:90.000", "X:0.000 Y:0.000"),
    ]
    assert abs(zero_error(stage, 100, 90)) < MICROSTEP_MM
    assert float(output[-1].split("Z:")[1].split()[0]) == pytest.approx(9, abs=MICROSTEP_MM)


@pytest.mark.parametrize("activate", ["", "M118 out"])
def test_axes_that_lean_keep_their_place_when_z_is_homed_elsewhere(tmp_path: Path, activate: str) -> None:
    sections = "[safe_z_home]\nhome_xy_position: 100, 90\n[skew_correction]\n"
    stage = ProbeStage(tmp_path, machine_text(sections=sections, activate_gcode=activate), bed=TILTED)
    before = ("G28", "SET_SKEW XY=100.8,100,71", "G1 Z5 F600", "G1 X20 Y30 F6000")
    lines = (*before, "G28 Z", "M114", "G1 Z5", "PROBE", "M114", "G1 Z5", "G1 X20 Y30")
    places = [text for text in stage.do(*lines) if text.startswith("X:")]
    assert places[0].split()[:2] == places[1].split()[:2]
    skew = re.findall(r"[XY]:(\S+)", places[0])
    steps = {name: motor.count / 80 for name, motor in stage.page("mcu").motors.items()}
    # The motors went 80 mm along X and 60 mm along Y to where Z is homed, and Y adds to X.
    factor = (float(skew[0]) - 100) / 60
    assert abs(factor) > 0.005
    assert (steps["stepper_x"], steps["stepper_y"]) == pytest.approx((20 - 30 * factor, 30), abs=0.03)


def test_axes_with_tables_are_measured_too(tmp_path: Path) -> None:
    stage = ProbeStage(tmp_path, machine_text(sections="[axis_tables]\n"), bed=TILTED)
    output = stage.do("G28", "G1 X60 Y30 Z6 F900", "PROBE", "M114", "G1 Z5")
    (found,) = heights(output)
    assert found == pytest.approx(OFFSET[2] + stage.trigger_z(60, 30) - stage.trigger_z(0, 0), abs=0.005)
    assert float(output[-1].split("Z:")[1].split()[0]) == pytest.approx(found, abs=0.01)
    assert stage.true_mm("z") - stage.trigger_z(0, 0) == pytest.approx(5 - OFFSET[2], abs=0.005)


def test_homing_override_homes_z_where_it_says(tmp_path: Path) -> None:
    override = """[homing_override]
gcode:
  {% if 'Z' in rawparams or not rawparams %}
  G28 X Y
  G0 X80 Y50 F6000
  G28 Z
  G0 Z9
  {% else %}
  G28 {rawparams}
  {% endif %}
"""
    stage = ProbeStage(tmp_path, machine_text(sections=override, activate_gcode="M118 out"), bed=TILTED)
    assert stage.do("G28", "G28 X", "M114")[0] == "echo: out"
    assert abs(zero_error(stage, 80, 50)) < MICROSTEP_MM


# ---------------------------------------------------------------------------------------------- calibrating


def test_accuracy_reports_the_spread_of_its_measurements(tmp_path: Path) -> None:
    output = measured(tmp_path, "PROBE_ACCURACY SAMPLES=6", noise_mm=0.03)
    found = heights(output)
    assert len(found) == 6
    figures = dict(part.rsplit(" ", 1) for part in output[-1].partition(": ")[2].split(", "))
    # Of heights that were rounded to a millionth of a millimetre.
    assert float(figures["range"]) == pytest.approx(np.ptp(found), abs=1.5e-6)
    assert float(figures["standard deviation"]) == pytest.approx(np.std(found), abs=1.5e-6)
    assert output[0].startswith("PROBE_ACCURACY at X:0.000 Y:0.000 Z:6.000 (samples=6")
    assert len(heights(measured(tmp_path, "PROBE_ACCURACY"))) == 10


def test_the_offset_is_found_by_hand_and_kept(tmp_path: Path) -> None:
    """The bed is at 0, and the probe truly triggers 0.4 mm higher than configured."""
    stage = ProbeStage(tmp_path, bed=BedSettings(z_offset_mm=OFFSET[2] + 0.4))
    output = stage.do(
        *("G28", "G1 X50 Y60 Z6 F6000", "PROBE_CALIBRATE SPEED=4", "M114"),
        *("TESTZ Z=-5", "TESTZ Z=-1.9", "ACCEPT"),
    )
    place = next(text for text in output if text.startswith("X:"))
    assert place.startswith(f"X:{50 + OFFSET[0]:.3f} Y:{60 + OFFSET[1]:.3f} Z:6.")
    found = re.fullmatch(r"probe: z_offset: (1\.\d+); SAVE_CONFIG writes it and restarts", output[-1])
    assert found is not None, output
    assert float(found[1]) == pytest.approx(1.9, abs=MICROSTEP_MM)
    assert stage.machine is not None
    assert stage.machine.unsaved.pending == {"probe": {"z_offset": found[1]}}


def test_an_offset_of_z_becomes_part_of_it(tmp_path: Path) -> None:
    stage = ProbeStage(tmp_path)
    output = stage.do("G28", "Z_OFFSET_APPLY_PROBE", "SET_GCODE_OFFSET Z=-0.12", "Z_OFFSET_APPLY_PROBE")
    assert output[0] == "the offset of Z is 0"
    assert stage.machine is not None
    assert stage.machine.unsaved.pending == {"probe": {"z_offset": "1.620"}}


def test_macros_and_front_ends_see_what_was_found(tmp_path: Path) -> None:
    macro = """[gcode_macro SEE]
gcode:
  {% set found = printer.probe %}
  M118 {found.name} {found.last_query} {found.last_probe_position} {'%.3f'|format(found.last_z_result)}
  {% set hand = printer.manual_probe %}
  M118 {hand.is_active} {hand.z_position} {hand.z_position_lower} {hand.z_position_upper}
"""
    stage = ProbeStage(tmp_path, machine_text(sections=macro), bed=TILTED)
    output = stage.do(
        *("G28", "SEE", "G1 Z4 F600", "G1 X60 Y30 F6000", "PROBE", "QUERY_PROBE", "SEE"),
        *("MANUAL_PROBE", "TESTZ Z=1", "TESTZ Z=-0.5", "SEE"),
    )
    told = [text.removeprefix("echo: ") for text in output if text.startswith("echo: ")]
    found = heights(output)[0]
    assert told[0] == "probe False [0.0, 0.0, 0.0] 0.000"
    assert told[1] == "False None None None"
    name, query, place = told[2].split(" ", 2)
    assert (name, query) == ("probe", "True")
    assert place.startswith("[80.0, 40.0, ")
    assert float(place.split(", ")[2].split("]")[0]) == pytest.approx(found - OFFSET[2], abs=1e-6)
    assert place.endswith(f" {found:.3f}")
    active, z, lower, upper = told[5].split()
    assert active == "True"
    assert [float(lower), float(z), float(upper)] == pytest.approx([found, found + 0.5, found + 1], abs=0.01)

"""What stands in for G28, and moves past all limits: judged by the steps that were made."""

from pathlib import Path

import pytest

from coordinator.assembly.check import check_config
from coordinator.gcode.errors import GCodeError
from tests.stages.printer_text import SWITCHES_CFG
from tests.stages.program_stage import ProgramStage
from tests.stages.switch_printer import PINS, STEPS_PER_MM, SwitchPrinter

AWAY = {"x": -20.0, "y": 15.0, "z": -4.0}
"""Where the axes stand, by the way to their switches."""
SAFE = "\n[safe_z_home]\nhome_xy_position: 30, 200\nz_hop: 3\nspeed: 100\nz_hop_speed: 10\n"
FORCE = "\n[force_move]\nenable_force_move: True\n"
ENDSTOPS = {"x": 0.0, "y": 250.0, "z": -0.5}


def printer(folder: Path, sections: str) -> SwitchPrinter:
    return SwitchPrinter(folder, dict(AWAY), machine=SWITCHES_CFG + sections)


def track(found: SwitchPrinter, axis: str) -> list[tuple[int, float]]:
    """Return every step of AXIS: when it was made, and where the axis was then."""
    step, direction, sign = PINS[axis]
    pins = found.stage.pins("mcu")
    level, at, track = 0, ENDSTOPS[axis] - found.distance_mm[axis], []
    for edge in found.stage.edges("mcu"):
        if edge["pin"] == pins[direction]:
            level = int(edge["level"])
        elif edge["pin"] == pins[step] and edge["level"]:
            at += sign * (1 if level else -1) / STEPS_PER_MM[axis]
            track.append((int(edge["true_ps"]), at))
    return track


def check_places(found: SwitchPrinter, x: float, y: float, z: float) -> None:
    for axis, wanted in zip("xyz", (x, y, z), strict=True):
        off = found.true_mm(axis, ENDSTOPS[axis]) - wanted
        assert abs(off) < 1.1 / STEPS_PER_MM[axis], (axis, off)


def check_told(found: SwitchPrinter, x: float, y: float, z: float) -> None:
    """Make sure that the last answer of M114 is this place, but for the rest of a step."""
    told = [float(word[2:]) for word in found.output[-1].split()[:3]]
    for axis, at, wanted in zip("xyz", told, (x, y, z), strict=True):
        assert abs(at - wanted) < 1 / STEPS_PER_MM[axis], (axis, at)


# ------------------------------------------------------------------------------------------- safe_z_home


def test_z_is_homed_at_its_place_with_the_head_lifted_before(tmp_path: Path) -> None:
    found = printer(tmp_path, SAFE)
    found.run("G28", "M114", "G1 X31 Y190 Z10 F6000")
    check_told(found, 30, 200, 3)
    check_places(found, 31, 190, 10)
    z, x = track(found, "z"), track(found, "x")
    began = z[0][1]
    lifted = next(at for at, place in z if place >= began + 3 - 0.01)
    assert lifted < x[0][0], "X moves only when the head is lifted"
    lowest_at, lowest = min(z, key=lambda step: step[1])
    assert lowest == pytest.approx(-0.5, abs=0.1)
    x_then = [place for at, place in x if at < lowest_at][-1]
    assert x_then == pytest.approx(30, abs=0.05)


def test_only_z_goes_there_and_back(tmp_path: Path) -> None:
    found = printer(tmp_path, SAFE + "move_to_previous: True\n")
    found.run("G28", "G1 X100 Y100 Z1 F6000", "G28 Z", "M114")
    check_told(found, 100, 100, 3)
    check_places(found, 100, 100, 3)


def test_z_waits_for_x_and_y(tmp_path: Path) -> None:
    found = printer(tmp_path, SAFE)
    with pytest.raises(GCodeError, match=r"^part\.gcode:2: G28 of Z comes before Y is homed"):
        found.run("G28 X", "G28 Z")


# --------------------------------------------------------------------------------------- homing_override


def test_lines_stand_in_for_g28_and_g28_among_them_homes(tmp_path: Path) -> None:
    lines = "".join(f"  {line}\n" for line in ("G1 Z5 F600", "G28 X Y", "G1 X100 Y100", "G28 Z"))
    override = f"\n[homing_override]\nset_position_z: 0\naxes: z\ngcode:\n{lines}"
    found = printer(tmp_path, override)
    found.run("G28", "G1 X101 Z2 F6000", "M114")
    assert found.output == ["X:101.000 Y:100.000 Z:2.000 E:0.000"]
    check_places(found, 101, 100, 2)
    z, x = track(found, "z"), track(found, "x")
    assert max(place for at, place in z if at < x[0][0]) == pytest.approx(z[0][1] + 5, abs=0.01)


def test_the_lines_are_a_template_that_sees_what_is_asked_and_where_the_head_is_taken_to_be(
    tmp_path: Path,
) -> None:
    text = (
        "{% if 'Z' in params or not params %}",
        "G1 Z{printer.toolhead.position.z + 5} F600",
        "{% endif %}",
        "{% for axis in 'XY' if axis in params %}",
        "G28 {axis}",
        "{% endfor %}",
    )
    lines = "".join(f"  {line}\n" for line in text)
    found = printer(tmp_path, f"\n[homing_override]\nset_position_z: 2\naxes: xyz\ngcode:\n{lines}")
    found.run("G28 X0 Z", "M114")
    assert found.output[0].split()[2] == "Z:7.000"
    z = track(found, "z")
    assert z[-1][1] == pytest.approx(z[0][1] + 5, abs=0.01)
    assert track(found, "x")
    assert not track(found, "y")


def test_a_bad_template_is_told_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(SWITCHES_CFG + "[homing_override]\ngcode:\n  G28\n  {% if %}\n")
    (problem,) = check_config(str(path))
    line = path.read_text().splitlines().index("  {% if %}") + 1
    assert str(problem).startswith(f"{path}:{line}: the template of [homing_override]: ")


def test_g28_of_other_axes_is_not_overridden(tmp_path: Path) -> None:
    found = printer(tmp_path, "\n[homing_override]\naxes: z\ngcode:\n  G28 X\n")
    found.run("G28 Y", "G1 Y200 F6000", "M114")
    assert found.output[0].split()[1] == "Y:200.000"
    assert not track(found, "x")


def test_two_that_stand_in_for_g28_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(SWITCHES_CFG + SAFE + "[homing_override]\ngcode:\n  G28 X\n")
    (problem,) = check_config(str(path))
    assert "both replace G28; remove one" in str(problem)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("30, 200", "30", "must be X and Y in mm with a comma between them"),
        ("z_hop: 3", "z_hopp: 3", "did you mean 'z_hop'?"),
    ],
)
def test_mistakes_in_safe_z_home_are_told(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(SWITCHES_CFG + SAFE.replace(old, new))
    (problem,) = check_config(str(path))
    assert sentence in str(problem)


# -------------------------------------------------------------------------------------------- force_move


def test_one_motor_moves_alone_and_the_place_can_be_said(tmp_path: Path) -> None:
    found = printer(tmp_path, FORCE)
    found.run(
        "FORCE_MOVE STEPPER=stepper_z DISTANCE=3 VELOCITY=5 ACCEL=100",
        "FORCE_MOVE STEPPER=stepper_z DISTANCE=-1 VELOCITY=5",
        "SET_KINEMATIC_POSITION X=100 Y=100 Z=10",
        "G1 Z12 F600",
        "M114",
    )
    assert found.output == ["X:100.000 Y:100.000 Z:12.000 E:0.000"]
    z = track(found, "z")
    began = z[0][1] - 1 / 400
    assert z[-1][1] == pytest.approx(began + 4, abs=1.5 / 400)
    assert max(place for _, place in z[:1400]) == pytest.approx(began + 3, abs=1.5 / 400)
    assert not track(found, "x")
    assert not track(found, "y")


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("FORCE_MOVE STEPPER=stepper_q DISTANCE=1 VELOCITY=5", "no 'stepper_q'; did you mean stepper_z?"),
        ("FORCE_MOVE STEPPER=stepper_x VELOCITY=5", "has no DISTANCE"),
        ("FORCE_MOVE STEPPER=stepper_x DISTANCE=nan VELOCITY=5", "DISTANCE of FORCE_MOVE is 'nan'"),
        ("FORCE_MOVE STEPPER=stepper_x DISTANCE=2000 VELOCITY=5", "-1000 to 1000 are possible"),
        ("FORCE_MOVE STEPPER=stepper_x DISTANCE=1 VELOCITY=5 ACCEL=1e-9", "must be at least 0.001 mm/s²"),
        ("SET_KINEMATIC_POSITION X=a", "X of SET_KINEMATIC_POSITION is 'a'"),
        ("SET_KINEMATIC_POSITION SET_HOMED=Q", "must be letters of X Y Z"),
    ],
)
def test_bad_parameters_end_the_program_with_the_line(tmp_path: Path, line: str, sentence: str) -> None:
    error = ProgramStage(tmp_path, FORCE, SWITCHES_CFG).error(line)
    assert error.startswith("part.gcode:1: ")
    assert sentence in error


def test_a_motor_that_moved_alone_leaves_the_axes_unknown(tmp_path: Path) -> None:
    with pytest.raises(GCodeError, match=r"^part\.gcode:3: X is to move before it is homed"):
        printer(tmp_path, FORCE).run(
            "G28", "FORCE_MOVE STEPPER=stepper_x DISTANCE=3 VELOCITY=5", "G1 X20 F6000"
        )


def test_axes_can_be_said_to_be_unknown(tmp_path: Path) -> None:
    with pytest.raises(GCodeError, match=r"^part\.gcode:3: Z is to move before it is homed"):
        printer(tmp_path, FORCE).run("SET_KINEMATIC_POSITION Z=5 CLEAR_HOMED=Z", "G1 X5 F600", "G1 Z6")


def test_without_leave_there_are_no_such_commands(tmp_path: Path) -> None:
    found = printer(tmp_path, "\n[force_move]\nenable_force_move: False\n")
    found.run("SET_KINEMATIC_POSITION X=5")
    assert "unknown command SET_KINEMATIC_POSITION" in found.output[0]


# ------------------------------------------------------------------------------------------ homing_accel


def test_homing_keeps_to_its_own_acceleration(tmp_path: Path) -> None:
    """From rest the way is a·t²/2: after 100 steps of 1/80 mm at 50 mm/s², t = √(2·1.25/50) s."""
    text = SWITCHES_CFG.replace("homing_speed: 50\n", "homing_speed: 50\nhoming_accel: 50\n")
    found = SwitchPrinter(tmp_path, dict(AWAY), machine=text)
    found.run("G28 X")
    x = track(found, "x")
    first, later = x[0][0], x[99][0]
    expected_s = (2 * (99.5 / 80) / 50) ** 0.5 - (2 * (0.5 / 80) / 50) ** 0.5
    assert (later - first) * 1e-12 == pytest.approx(expected_s, rel=0.02)


# ------------------------------------------------------------------------------------------ after homing


def test_after_g28_the_head_is_within_its_limits_and_can_come_back_there(tmp_path: Path) -> None:
    found = printer(tmp_path, "")
    found.run(
        "G28", "M114", "SAVE_GCODE_STATE", "G91", "G1 X5 Y-5 Z3 F3000", "G90", "RESTORE_GCODE_STATE MOVE=1"
    )
    x, y, z = (float(word[2:]) for word in found.output[-1].split()[:3])
    assert 0 <= x < 2 / STEPS_PER_MM["x"]
    assert 250 - 2 / STEPS_PER_MM["y"] < y <= 250
    assert z >= -1
    check_places(found, x, y, z)

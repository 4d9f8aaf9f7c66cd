"""Everything that is wrong with a configuration is told at once, and nothing that only follows from it."""

from pathlib import Path

import pytest

from coordinator.machine import check as check_module
from coordinator.machine.check import check_config

EXAMPLES = sorted(Path("config").rglob("*.cfg"))
GOOD = """\
[mcu]
serial: /dev/ttyUSB0
[printer]
kinematics: cartesian
max_velocity: 250
max_accel: 3000
[stepper_x]
step_pin: PB0
dir_pin: PB1
microsteps: 16
rotation_distance: 40
position_endstop: 0
position_max: 250
[stepper_y]
step_pin: PB3
dir_pin: PB4
microsteps: 16
rotation_distance: 40
position_endstop: 0
position_max: 250
[stepper_z]
step_pin: PB6
dir_pin: PB7
microsteps: 16
rotation_distance: 8
position_endstop: 0
position_max: 250
"""


def mistakes(folder: Path, *changes: tuple[str, str], text: str = GOOD) -> list[str]:
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / "printer.cfg"
    path.write_text(text)
    return [str(problem).removeprefix(str(path)) for problem in check_config(str(path))]


@pytest.mark.parametrize("path", EXAMPLES, ids=str)
def test_nothing_is_wrong_with_the_examples(path: Path) -> None:
    assert check_config(str(path)) == []


def test_all_kinds_of_mistakes_at_once(tmp_path: Path) -> None:
    told = mistakes(
        tmp_path,
        ("serial: /dev/ttyUSB0", "serial: /dev/ttyUSB0\nbaud: fast\nnonsense"),
        ("max_velocity: 250", "max_velocity: -5"),
        ("max_accel", "max_acel"),
        ("dir_pin: PB1", "dir_pin: PB0"),
        ("rotation_distance: 40\nposition_endstop: 0\nposition_max: 250\n[stepper_y]", "[stepper_y]"),
        ("step_pin: PB3", "step_pin: foo:PB3"),
        ("rotation_distance: 8\nposition_endstop: 0", "rotation_distance: 8\nposition_endstop: 300"),
    )
    starts = [
        ":3: option 'baud' of [mcu] is 'fast', must be a whole number",
        ":4: 'nonsense' is neither a section header nor an option",
        ":5: [printer] lacks option 'max_accel'",
        ":7: option 'max_velocity' of [printer] is '-5', must be",
        ":8: [printer] has no option 'max_acel'; did you mean 'max_accel'?",
        ":9: [stepper_x] lacks option 'position_max'",
        ":9: [stepper_x] lacks option 'rotation_distance'",
        ":11: 'dir_pin' of [stepper_x]: pin mcu:PB0 is already used for 'step_pin' of [stepper_x]",
        ":14: 'step_pin' of [stepper_y]: there is no node 'foo'",
        ":25: option 'position_endstop' of [stepper_z] is '300', must be within position_min and",
    ]
    for line, start in zip(sorted(told), sorted(starts), strict=True):
        assert line.startswith(start)


def test_two_sections_with_mistakes_that_end_their_reading(tmp_path: Path) -> None:
    told = mistakes(
        tmp_path,
        (
            "dir_pin: PB4\nmicrosteps: 16\nrotation_distance: 40\nposition_endstop: 0",
            "dir_pin: PB4\nmicrosteps: 16\nrotation_distance: 40\nposition_endstop: 125",
        ),
        ("rotation_distance: 8\nposition_endstop: 0", "rotation_distance: 8\nposition_endstop: 125"),
    )
    assert [line.split(",")[0] for line in told] == [
        ":19: option 'position_endstop' of [stepper_y] is '125'",
        ":26: option 'position_endstop' of [stepper_z] is '125'",
    ]


def test_sections_that_do_not_exist(tmp_path: Path) -> None:
    told = mistakes(tmp_path, text=GOOD + "[stepper_w]\nstep_pin: PA9\n[heater_bad]\npin: PA1\n[printer x]\n")
    assert [line.partition("]")[0] for line in told] == [
        ":28: [stepper_w",
        ":30: there is no section [heater_bad",
        ":32: [printer x",
    ]


@pytest.mark.parametrize("section", ["mcu", "printer", "stepper_y"])
def test_a_section_that_is_missing_is_all_that_is_told(tmp_path: Path, section: str) -> None:
    parts = [part for part in GOOD.split("[") if not part.startswith(f"{section}]")]
    assert len(parts) < len(GOOD.split("["))
    (told,) = mistakes(tmp_path, text="[".join(parts))
    assert f"[{section}]" in told


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    (told,) = check_config(str(tmp_path / "none.cfg"))
    assert "none.cfg" in str(told)
    (tmp_path / "printer.cfg").write_bytes(b"\0\1\2")
    assert len(check_config(str(tmp_path / "printer.cfg"))) == 1


def test_what_is_no_configuration_at_all_ends(tmp_path: Path) -> None:
    path = tmp_path / "noise.cfg"
    path.write_text("\n".join(f"line {n}" for n in range(10_000)))
    assert len(check_config(str(path))) == check_module.PROBLEMS_MAX

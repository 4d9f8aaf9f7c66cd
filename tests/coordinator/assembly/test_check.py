"""Everything that is wrong with a configuration is told at once, and nothing that only follows from it."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from coordinator.assembly import check as check_module
from coordinator.assembly.check import check_config
from coordinator.assembly.load import load_machine
from coordinator.cli.commands.config import check
from coordinator.modules.module_set import build_modules

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


MODULES = """\
[fan]
pin: PA1
max_power: 2
[tmc2209 stepper_z]
uart_pin: PD1
run_current: 0.8
[safe_z_home]
home_xy_position: 100, 100
[gcode_macro G28]
gcode:
    G28
"""


@pytest.mark.parametrize(
    "missing",
    [("printer",), ("stepper_x",), ("stepper_z",), ("stepper_x", "stepper_z"), ("printer", "stepper_z")],
)
def test_modules_are_checked_where_sections_are_missing(tmp_path: Path, missing: tuple[str, ...]) -> None:
    parts = [part for part in GOOD.split("[") if not part.startswith(missing)]
    told = mistakes(tmp_path, text="[".join(parts) + MODULES)
    begin = "[".join(parts).count("\n")
    named = [f": there is no section [{name}]; add it" for name in missing]
    assert [line.partition(" of ")[0] for line in told if "no section" not in line] == [
        f":{begin + 3}: option 'max_power'",
        f":{begin + 9}: [gcode_macro G28] takes the name",
    ]
    assert [line[: len(start)] for line, start in zip(told, named, strict=False)] == named


@pytest.mark.parametrize("value", ["", "position_max: far\n"])
def test_a_range_that_nobody_gave_makes_no_place_lie_outside(tmp_path: Path, value: str) -> None:
    text = GOOD.replace("position_max: 250\n[stepper_y]", f"{value}[stepper_y]")
    (told,) = mistakes(tmp_path, text=text + "[safe_z_home]\nhome_xy_position: 100, 100\n")
    assert "'position_max'" in told


def test_without_printer_nobody_knows_what_towers_are(tmp_path: Path) -> None:
    text = GOOD[: GOOD.index("[printer]")] + "[stepper_a]\n[stepper_b]\n[stepper_c]\n[fan]\nmax_power: 2\n"
    (told,) = mistakes(tmp_path, text=text)
    assert told == ": there is no section [printer]; add it"


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    (told,) = check_config(str(tmp_path / "none.cfg"))
    assert "none.cfg" in str(told)
    (tmp_path / "printer.cfg").write_bytes(b"\0\1\2")
    assert len(check_config(str(tmp_path / "printer.cfg"))) == 1


def test_what_is_no_configuration_at_all_ends(tmp_path: Path) -> None:
    path = tmp_path / "noise.cfg"
    path.write_text("\n".join(f"line {n}" for n in range(10_000)))
    assert len(check_config(str(path))) == check_module.PROBLEMS_MAX


def test_mistakes_within_templates_end_no_check(tmp_path: Path) -> None:
    (tmp_path / "more.cfg").write_text("[gcode_macro C]\ngcode:\n    {% endfor %}\n")
    sections = """\
[gcode_macro A]
gcode:
    G28
    {% if %}
[gcode_macro B]
gcode:
    {% for %}
[gcode_macro C]
[delayed_gcode D]
gcode:
    {{ }
[fan_generic x]
pin: PA1
max_power: 2
[include more.cfg]
"""
    told = mistakes(tmp_path, text=GOOD + sections)
    start = len(GOOD.splitlines())
    assert [line.partition(": ")[0] for line in told if "more.cfg" not in line] == [
        f":{start + line}" for line in (4, 7, 11, 14)
    ]
    (included,) = (line for line in told if "more.cfg" in line)
    assert included.startswith(f"{tmp_path}/more.cfg:3: the template of [gcode_macro C]")


NAMED = (
    *("gcode_macro", "fan_generic", "delayed_gcode", "output_pin", "heater_fan", "temperature_sensor"),
    *("heater_generic", "controller_fan", "tmc2209", "gcode_button", "filament_switch_sensor"),
    *("verify_heater", "temperature_fan", "thermistor", "pid_profile", "static_digital_output"),
)


@pytest.mark.parametrize("kind", NAMED)
def test_sections_that_need_a_name(tmp_path: Path, kind: str) -> None:
    told = mistakes(tmp_path, text=f"{GOOD}[{kind}]\n")
    line = len(GOOD.splitlines()) + 1
    assert f":{line}: [{kind}] needs a name; write [{kind} NAME]" in told


def test_the_plain_section_of_a_kind_that_has_profiles(tmp_path: Path) -> None:
    assert mistakes(tmp_path, text=GOOD + "[skew_correction]\n[skew_correction mine]\n") == []


EXTRUDER = """\
[extruder]
step_pin: PC0
dir_pin: PC1
microsteps: 16
rotation_distance: 22.5
nozzle_diameter: 0.4
filament_diameter: 1.75
heater_pinn: PC2
sensor_type: Generic 3950
sensor_pin: PC3
control: watermark
min_temp: 0
max_temp: 250
"""


def test_an_option_that_is_misspelt_makes_no_others_useless(tmp_path: Path) -> None:
    (told,) = mistakes(tmp_path, text=GOOD + EXTRUDER)
    assert told.endswith(": [extruder] has no option 'heater_pinn'; did you mean 'heater_pin'?")
    useless = mistakes(tmp_path, text=GOOD + EXTRUDER.replace("heater_pinn", "colour"))
    assert sum("has no effect with the others" in line for line in useless) == 5


@pytest.mark.parametrize("rename", ["rename_existin: G28.1", "rename_existing: G-28"])
def test_a_name_for_a_command_that_is_wrong_is_not_asked_for_again(tmp_path: Path, rename: str) -> None:
    (told,) = mistakes(tmp_path, text=f"{GOOD}[gcode_macro G28]\n{rename}\ngcode:\n    G28.1\n")
    assert "rename_existing" in told
    assert "takes the name" not in told


def test_the_end_says_what_will_not_act_and_what_that_means(tmp_path: Path) -> None:
    path = tmp_path / "printer.cfg"
    probed = GOOD.replace(
        "rotation_distance: 8\n", "rotation_distance: 8\nendstop_pin: probe:z_virtual_endstop\n"
    )
    path.write_text(f"{probed}[dockable_probe]\npin: PA9\nz_offset: 1\n[neopixel a]\npin: PA8\n")
    report = check(str(path))
    assert report.ok
    head, _, listed = report.to_text().partition("What will not act, and what that means for a print:\n")
    assert head.strip() == f"{path}: no mistakes"
    lines = [line.strip().replace(f"{path}:", "") for line in listed.splitlines()]
    homed = (
        "endstop_pin of [stepper_z]: not supported yet, ignored: an axis that has no other endstop is refused"
    )
    probed = "nothing is probed; an axis that it homes is refused by G28, lines that probe end a job"
    assert lines == [
        f"21: {homed} by G28",
        f"29: [dockable_probe]: not supported yet, ignored: {probed}",
        "32: [neopixel a]: not supported yet, ignored: no light; a print is as it would be",
    ]
    means = {entry["section"]: entry["meaning"] for entry in report.to_json()["unsupported"]}
    assert means["neopixel a"] == "no light; a print is as it would be"


class Counted(dict[str, Mapping[str, str]]):
    """Sections; counts how often somebody goes through all of them."""

    rounds = 0

    def __iter__(self) -> Iterator[str]:
        self.rounds += 1
        return super().__iter__()


def test_more_modules_do_not_go_through_all_sections_more_often(tmp_path: Path) -> None:
    """Each did, at each of the readings that 20 mistakes need: half of the time."""
    path, rounds = tmp_path / "printer.cfg", list[int]()
    for count in (3, 30):
        path.write_text(GOOD + "".join(f"[gcode_macro TRY_{n}]\ngcode: M117\n" for n in range(count)))
        machine = load_machine(str(path))
        sections = Counted(machine.modules.config)
        build_modules(replace(machine, modules=replace(machine.modules, config=sections)))
        rounds.append(sections.rounds)
    assert rounds[0] == rounds[1]

"""Every mistake in a configuration gets one sentence: file and line, names, what to do."""

import string
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.assembly.load import load_machine
from coordinator.config.errors import ConfigError
from tests.profiles import examples
from tests.stages.printer_text import PRINTER_CFG, changed, write


def without(section: str) -> str:
    """Return the configuration without a section."""
    start = PRINTER_CFG.index(f"[{section}]")
    end = PRINTER_CFG.find("\n[", start)
    return PRINTER_CFG[:start] + (PRINTER_CFG[end + 1 :] if end >= 0 else "")


def sentence_for(tmp_path: Path, text: str) -> str:
    with pytest.raises(ConfigError) as error:
        load_machine(write(tmp_path, text))
    assert error.value.place.path == f"{tmp_path}/printer.cfg"
    return str(error.value).replace(f"{tmp_path}/", "")


CASES = {
    "typo in a required option": (
        changed("step_pin: PA0", "step_pn: PA0"),
        "printer.cfg:13: [stepper_x] has no option 'step_pn'; did you mean 'step_pin'?",
    ),
    "typo in an optional option": (
        changed("max_accel: 5000\n", "max_accel: 5000\nsquare_corner_velocty: 5\n"),
        (
            "printer.cfg:11: [printer] has no option 'square_corner_velocty'; did you mean"
            " 'square_corner_velocity'?"
        ),
    ),
    "typo in an option of a later module": (
        PRINTER_CFG + "heater_pn: PB0\n",
        "printer.cfg:40: [extruder] has no option 'heater_pn'; did you mean 'heater_pin'?",
    ),
    "option like no other": (
        changed("max_accel: 5000\n", "max_accel: 5000\nzzz: 5\n"),
        "printer.cfg:11: [printer] has no option 'zzz'; remove it or correct its name",
    ),
    "unknown section": (
        PRINTER_CFG + "[heater_bet]\n",
        "printer.cfg:40: there is no section [heater_bet]; did you mean [heater_bed]?",
    ),
    "section in wrong case": (
        changed("[printer]", "[Printer]"),
        "printer.cfg:7: there is no section [Printer]; did you mean [printer]?",
    ),
    "section like no other": (
        PRINTER_CFG + "[qqqq x]\n",
        "printer.cfg:40: there is no section [qqqq x]; remove it or correct its name",
    ),
    "single section with a name": (
        changed("[printer]", "[printer one]"),
        "printer.cfg:7: [printer one] must be [printer]: there is only one of it",
    ),
    "missing pin": (
        changed("dir_pin: PA1\n", ""),
        (
            "printer.cfg:12: [stepper_x] lacks option 'dir_pin', a pin as in PA3 or toolhead:PA3, may"
            " begin with !: the driver's direction input; ! when high means negative"
        ),
    ),
    "missing option": (
        changed("rotation_distance: 8\n", ""),
        (
            "printer.cfg:26: [stepper_z] lacks option 'rotation_distance', a number in mm, at least"
            " 0.001 and at most 10000: way of the axis for one turn of the motor, or of the last gear"
        ),
    ),
    "steps that are too small to be counted": (
        changed("rotation_distance: 8\n", "rotation_distance: 0.5\ngear_ratio: 1000:1\n"),
        (
            "printer.cfg:26: a step of [stepper_z] is 1.5625e-07 mm, must be at least 3e-07 mm; correct its"
            " gear_ratio, microsteps and the like"
        ),
    ),
    "pin used twice": (
        changed("dir_pin: PA3", "dir_pin: !PA1"),
        (
            "printer.cfg:21: 'dir_pin' of [stepper_y]: pin mcu:PA1 is already used for 'dir_pin' of"
            " [stepper_x] (printer.cfg:14)"
        ),
    ),
    "pin used by a later module": (
        PRINTER_CFG + "[fan]\npin: PA1\n",
        (
            "printer.cfg:41: 'pin' of [fan]: pin mcu:PA1 is already used for 'dir_pin' of [stepper_x]"
            " (printer.cfg:14)"
        ),
    ),
    "pin used by the heater": (
        PRINTER_CFG + "heater_pin: toolhead:PA0\n",
        (
            "printer.cfg:40: 'heater_pin' of [extruder]: pin toolhead:PA0 is already used for"
            " 'step_pin' of [extruder] (printer.cfg:34)"
        ),
    ),
    "pin of an unknown node": (
        changed("toolhead:PA0", "tolhead:PA0"),
        ("printer.cfg:34: 'step_pin' of [extruder]: there is no node 'tolhead'; did you mean 'toolhead'?"),
    ),
    "pin of a node like no other": (
        changed("toolhead:PA0", "zz:PA0"),
        "printer.cfg:34: 'step_pin' of [extruder]: there is no node 'zz'; add a section [mcu zz]",
    ),
    "step and direction on two nodes": (
        changed("toolhead:PA1", "PB1"),
        (
            "printer.cfg:35: option 'dir_pin' of [extruder] is 'PB1', on node 'mcu', but step_pin is"
            " on 'toolhead'; both must be on one node"
        ),
    ),
    "pin misspelt": (
        changed("step_pin: PA0", "step_pin: !!PA0"),
        (
            "printer.cfg:13: option 'step_pin' of [stepper_x] is '!!PA0', must be a pin as in PA3 or"
            " toolhead:PA3, may begin with !"
        ),
    ),
    "pull-up on an output": (
        changed("step_pin: PA0", "step_pin: ^PA0"),
        ("printer.cfg:13: option 'step_pin' of [stepper_x] is '^PA0', which is an output; remove the ^ or ~"),
    ),
    "wrong uuid": (
        changed("11aa22bb33cc", "11aa22bb33"),
        (
            "printer.cfg:2: option 'canbus_uuid' of [mcu] is '11aa22bb33', must be 12 hex digits such"
            " as 11aa22bb33cc"
        ),
    ),
    "uuid of two nodes": (
        changed("serial: /dev/ttyACM0", "canbus_uuid: 11AA22BB33CC"),
        (
            "printer.cfg:5: nodes 'mcu' (printer.cfg:2) and 'toolhead' are both '11aa22bb33cc'; each"
            " node needs its own"
        ),
    ),
    "node without connection": (
        changed("serial: /dev/ttyACM0\n", ""),
        ("printer.cfg:4: [mcu toolhead] does not say how to reach the node; add 'canbus_uuid' or 'serial'"),
    ),
    "node with two connections": (
        changed("serial:", "canbus_uuid: 11aa22bb33dd\nserial:"),
        "printer.cfg:5: [mcu toolhead] has both 'serial' and 'canbus_uuid'; keep one of them",
    ),
    "baud on a bus": (
        changed("11aa22bb33cc\n", "11aa22bb33cc\nbaud: 250000\n"),
        "printer.cfg:3: option 'baud' of [mcu] has no effect with the others; remove it",
    ),
    "reset line on a bus": (
        changed("11aa22bb33cc\n", "11aa22bb33cc\nrestart_method: arduino\n"),
        (
            "printer.cfg:3: option 'restart_method' of [mcu] is 'arduino', but a node on CAN restarts"
            " by command only; remove it"
        ),
    ),
    "bad bus": (
        changed("11aa22bb33cc\n", "11aa22bb33cc\ncanbus_interface: can 0\n"),
        (
            "printer.cfg:3: option 'canbus_interface' of [mcu] is 'can 0', must be an interface such"
            " as can0, virtual:PATH or INTERFACE:CHANNEL"
        ),
    ),
    "primary named twice": (
        changed("[mcu toolhead]", "[mcu mcu]"),
        "printer.cfg:4: 'mcu' is not a name for a node; use letters, digits and _",
    ),
    "below a bound": (
        changed("max_velocity: 300", "max_velocity: 0"),
        (
            "printer.cfg:9: option 'max_velocity' of [printer] is '0', must be a number in mm/s,"
            " at least 0.001 and at most 100000"
        ),
    ),
    "above a bound": (
        changed("microsteps: 16", "microsteps: 512"),
        (
            "printer.cfg:15: option 'microsteps' of [stepper_x] is '512', must be a whole number, at"
            " least 1 and at most 256"
        ),
    ),
    "not a number": (
        changed("max_accel: 5000", "max_accel: fast"),
        (
            "printer.cfg:10: option 'max_accel' of [printer] is 'fast', must be a number in mm/s²,"
            " at least 0.001 and at most 10000000"
        ),
    ),
    "not finite": (
        changed("max_accel: 5000", "max_accel: nan"),
        (
            "printer.cfg:10: option 'max_accel' of [printer] is 'nan', must be a number in mm/s²,"
            " at least 0.001 and at most 10000000"
        ),
    ),
    "odd full steps": (
        changed("microsteps: 16", "microsteps: 16\nfull_steps_per_rotation: 202"),
        (
            "printer.cfg:16: option 'full_steps_per_rotation' of [stepper_x] is '202', must be a"
            " multiple of 4, at least 4 and at most 10000"
        ),
    ),
    "gear ratio": (
        changed("microsteps: 16", "microsteps: 16\ngear_ratio: 3"),
        (
            "printer.cfg:16: option 'gear_ratio' of [stepper_x] is '3', must be pairs of teeth as in"
            " 50:10 or 50:17, 3:1 (motor first)"
        ),
    ),
    "unknown kinematics": (
        changed("corexy", "corexyz"),
        (
            "printer.cfg:8: option 'kinematics' of [printer] is 'corexyz', must be cartesian, corexy, corexz,"
            " delta, deltesian, generic_cartesian, hybrid_corexy, hybrid_corexz, none, polar, rotary_delta or"
            " winch"
        ),
    ),
    "empty range": (
        changed("position_max: 200", "position_max: 0"),
        ("printer.cfg:17: option 'position_max' of [stepper_x] is '0', must be above position_min (0 mm)"),
    ),
    "endstop outside": (
        changed("position_max: 200", "position_max: 200\nposition_endstop: 201"),
        (
            "printer.cfg:18: option 'position_endstop' of [stepper_x] is '201', must be within"
            " position_min and position_max (0 to 200 mm)"
        ),
    ),
    "endstop in the middle": (
        changed("position_max: 200", "position_max: 200\nposition_endstop: 100"),
        (
            "printer.cfg:18: option 'position_endstop' of [stepper_x] is '100', at neither end of the"
            " axis; add homing_positive_dir to say where to home to"
        ),
    ),
    "homing away from the endstop": (
        changed("position_max: 200", "position_max: 200\nposition_endstop: 0\nhoming_positive_dir: yes"),
        (
            "printer.cfg:19: option 'homing_positive_dir' of [stepper_x] is 'yes', but"
            " position_endstop is 0 mm, the other end of the axis"
        ),
    ),
    "endstop without position": (
        changed("position_max: 200", "position_max: 200\nendstop_pin: ^PB0"),
        (
            "printer.cfg:12: [stepper_x] lacks option 'position_endstop', a number in mm, at least"
            " -100000 and at most 100000: where the axis is when the endstop switches"
        ),
    ),
    "filament thinner than the nozzle": (
        changed("filament_diameter: 1.75", "filament_diameter: 0.3"),
        (
            "printer.cfg:39: option 'filament_diameter' of [extruder] is '0.3', must be at least"
            " nozzle_diameter (0.4 mm)"
        ),
    ),
    "two ways to limit zig-zag": (
        changed("max_accel: 5000\n", "max_accel: 5000\nmax_accel_to_decel: 1\nminimum_cruise_ratio: 0.5\n"),
        ("printer.cfg:11: option 'max_accel_to_decel' of [printer] has no effect with the others; remove it"),
    ),
    "further steppers with a gap": (
        PRINTER_CFG + "[stepper_z2]\n",
        "printer.cfg:40: [stepper_z2] without [stepper_z1]: further steppers count from 1",
    ),
    "further stepper without number": (
        PRINTER_CFG + "[stepper_z0]\n",
        "printer.cfg:40: there is no section [stepper_z0]; did you mean [stepper_z]?",
    ),
    "missing include": (
        PRINTER_CFG + "[include macros.cfg]\n",
        "printer.cfg:40: cannot read 'macros.cfg': No such file or directory",
    ),
    "alias of an unknown node": (
        PRINTER_CFG + "[board_pins]\nmcu: toolhed\naliases: A=PA7\n",
        (
            "printer.cfg:41: option 'mcu' of [board_pins] is 'toolhed', there is no node 'toolhed';"
            " did you mean toolhead?"
        ),
    ),
    "alias without pin": (
        PRINTER_CFG + "[board_pins]\naliases: A\n",
        "printer.cfg:41: option 'aliases' of [board_pins] is 'A', 'A' is not NAME=PIN",
    ),
    "alias twice": (
        PRINTER_CFG + "[board_pins]\naliases: A=PA1, A=PA2\n",
        "printer.cfg:41: alias 'A' of node 'mcu' already means 'PA1'",
    ),
    "reserved alias": (
        changed("dir_pin: PA1", "dir_pin: A") + "[board_pins]\naliases: A=<GND>\n",
        "printer.cfg:14: 'dir_pin' of [stepper_x]: pin 'A' is reserved for <GND>; use another",
    ),
    "shared pin misspelt": (
        PRINTER_CFG + "[duplicate_pin_override]\npins: PA1, P A2\n",
        (
            "printer.cfg:41: option 'pins' of [duplicate_pin_override] is 'PA1, P A2', 'P A2' must be"
            " a pin as in PA3 or toolhead:PA3, may begin with ! or ^ or ~"
        ),
    ),
    "shared enable pin with other marks": (
        changed("dir_pin: PA1", "dir_pin: PA1\nenable_pin: !PB0").replace(
            "dir_pin: PA3", "dir_pin: PA3\nenable_pin: PB0"
        ),
        (
            "printer.cfg:23: 'enable_pin' of [stepper_y]: pin mcu:PB0 is shared with 'enable_pin' of"
            " [stepper_x] (printer.cfg:15) but has other marks (! ^ ~); make them the same"
        ),
    ),
}


@pytest.mark.parametrize(("text", "sentence"), CASES.values(), ids=CASES)
def test_one_sentence_for(tmp_path: Path, text: str, sentence: str) -> None:
    assert sentence_for(tmp_path, text) == sentence


@pytest.mark.parametrize(
    ("section", "sentence"),
    [
        ("mcu", "printer.cfg: there is no section [mcu]; add it to say how to reach the main board"),
        ("printer", "printer.cfg: there is no section [printer]; add it"),
        ("stepper_x", "printer.cfg: there is no section [stepper_x]; add it: every axis needs its stepper"),
        ("stepper_y", "printer.cfg: there is no section [stepper_y]; add it: every axis needs its stepper"),
        ("stepper_z", "printer.cfg: there is no section [stepper_z]; add it: every axis needs its stepper"),
    ],
)
def test_a_missing_section_is_named(tmp_path: Path, section: str, sentence: str) -> None:
    assert sentence_for(tmp_path, without(section)) == sentence


LINES = PRINTER_CFG.splitlines()
SCRAPS = [
    *("", "-1", "1e308", "1e-320", "9" * 5000, "inf", "0x10", "\u0661\u0662", "True", "\u200b"),
    *("PA0", "!^~", "mcu:", ":", "50:0", "a=b", "[fan]", "[include *.cfg]", "[stepper_x1]"),
    *("[board_pins]\naliases: PA0=<X>", "#*# <--- SAVE_CONFIG --->"),
]


@settings(max_examples=examples(400))
@given(
    line=st.integers(0, len(LINES) - 1),
    keep_option=st.booleans(),
    scrap=st.one_of(st.sampled_from(SCRAPS), st.text(max_size=20), st.text(string.punctuation, max_size=8)),
)
def test_whatever_stands_in_a_line_only_a_sentence_comes_back(
    tmp_path_factory: pytest.TempPathFactory, line: int, keep_option: bool, scrap: str
) -> None:
    lines = list(LINES)
    option, colon, _ = lines[line].partition(":")
    lines[line] = f"{option}{colon} {scrap}" if keep_option else scrap
    path = write(
        tmp_path_factory.getbasetemp(), "\n".join(lines).encode(errors="replace"), "fuzz/printer.cfg"
    )
    try:
        machine = load_machine(path)
    except ConfigError as error:
        assert str(error).startswith(path)  # noqa: PT017
        assert str(error).isprintable()  # noqa: PT017
        assert len(str(error)) < 600 + 2 * len(path)  # noqa: PT017
    else:
        assert all(0 < stepper.step_distance < 1e6 for stepper in machine.steppers)

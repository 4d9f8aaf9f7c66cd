"""Mistakes in the example machines of each kinematics: one sentence each."""

import math
from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.errors import ConfigError
from coordinator.config.sections.printer import KINEMATICS
from tests.profiles import is_full
from tests.stages.printer_text import changed, example_text, write

BAD: dict[str, tuple[str, str, str, str]] = {
    "option of another kinematics": (
        "cartesian",
        "kinematics: cartesian\n",
        "kinematics: cartesian\ndelta_radius: 100\n",
        (
            "option 'delta_radius' of [printer] belongs to kinematics delta, but this machine is"
            " cartesian; remove it"
        ),
    ),
    "section of another kinematics": (
        "cartesian",
        "[stepper_z1]",
        "[stepper_left]",
        (
            "[stepper_left] has no place in a machine of kinematics cartesian; remove it, or correct its"
            " name or 'kinematics' of [printer]"
        ),
    ),
    "tower missing": (
        "delta",
        "[stepper_c]",
        "[stepper_x]",
        (
            "there is no section [stepper_c]; add it: a delta has the towers stepper_a, stepper_b and"
            " stepper_c"
        ),
    ),
    "short rods": (
        "delta",
        "arm_length: 330",
        "arm_length: 150",
        (
            "option 'arm_length' of [stepper_a] is '150', must be above delta_radius (150 mm): the rods"
            " would not reach"
        ),
    ),
    "nearly level rods": (
        "delta",
        "arm_length: 330",
        "arm_length: 150.3",
        (
            "option 'arm_length' of [stepper_a] is '150.3', so short that carriages would be more than 12"
            " times as fast as the head even in the middle; correct it or delta_radius"
        ),
    ),
    "towers side by side": (
        "delta",
        "angle: 330",
        "angle: 220",
        (
            "option 'angle' of [stepper_b] is '220', only 10° away from [stepper_a]; they must be 30°"
            " apart at least"
        ),
    ),
    "no height": (
        "delta",
        "position_endstop: 400",
        "position_endstop: 30",
        (
            "option 'minimum_z_position' of [printer] is '-2', but at the rim the head reaches only up"
            " to Z -5.9097 mm, which leaves no room above -2 mm; correct the lengths, position_endstop"
            " and print_radius"
        ),
    ),
    "wide deltesian": (
        "deltesian",
        "print_width: 230",
        "print_width: 300",
        (
            "option 'print_width' of [printer] is '300', but rods would lie below min_angle; it can be"
            " at most 283.82 mm"
        ),
    ),
    "steep deltesian": (
        "deltesian",
        "min_angle: 20 ",
        "min_angle: 70 ",
        (
            "option 'arm_length' of [stepper_left] is '300', so short that the rod lies below min_angle"
            " already with the head in the middle; correct it"
        ),
    ),
    "bed without gears": (
        "polar",
        "gear_ratio: 80:16\n",
        "",
        (
            "[stepper_bed] lacks option 'gear_ratio', pairs of teeth as in 50:10 or 50:17, 3:1 (motor"
            " first): gears between motor and what it turns; 1:1 for none"
        ),
    ),
    "bed with a way per turn": (
        "polar",
        "gear_ratio: 80:16\n",
        "gear_ratio: 80:16\nrotation_distance: 40\n",
        "[stepper_bed] has no option 'rotation_distance'; remove it or correct its name",
    ),
    "an arm without end": (
        "polar",
        "position_endstop: 150\nposition_min: 5\nposition_max: 150",
        "position_endstop: 5\nposition_min: 5\nposition_max: 1e9",
        "option 'position_max' of [stepper_arm] is '1e9', must be above 0 and at most 100000",
    ),
    "endstops too far apart": (
        "delta",
        "[stepper_b]\n",
        "[stepper_b]\nposition_endstop: 90000\n",
        "the rods of [stepper_a] and the others do not meet when all are at their endstops; correct",
    ),
    "endstops of a deltesian too far apart": (
        "deltesian",
        "[stepper_right]\n",
        "[stepper_right]\nposition_endstop: 90000\n",
        "the rods of [stepper_left] and the others do not meet when all are at their endstops; correct",
    ),
    "arms out of reach": (
        "rotary_delta",
        "shoulder_height: 412.9",
        "shoulder_height: 600",
        (
            "option 'shoulder_height' of [printer] is '600', but then the arms do not reach down to Z 0"
            " mm; correct it, the arms, or minimum_z_position"
        ),
    ),
    "anchors on one line": (
        "winch",
        "anchor_x: -2000\nanchor_y: 1000",
        "anchor_x: 4000\nanchor_y: 4000",
        (
            "option 'anchor_x' of [stepper_c] is '4000', the anchors of stepper_a, stepper_b and"
            " stepper_c are on one line; move one off it"
        ),
    ),
    "one anchor twice": (
        "winch",
        "anchor_x: 0\nanchor_y: 0\nanchor_z: 3000",
        "anchor_x: 0\nanchor_y: -2000\nanchor_z: -100",
        ("option 'anchor_x' of [stepper_d] is '0', the anchor is that of [stepper_a]; correct one of them"),
    ),
    "carriage that is not there": (
        "generic_cartesian",
        "carriages: x+y",
        "carriages: x+carriage_y",
        (
            "option 'carriages' of [stepper belt_a] is 'x+carriage_y', but there is no carriage"
            " 'carriage_y'; there is x, y, z"
        ),
    ),
    "no sum": (
        "generic_cartesian",
        "carriages: x+y",
        "carriages: x++y",
        (
            "option 'carriages' of [stepper belt_a] is 'x++y', must be a sum of different carriages as"
            " in carriage_x, x-y or carriage_x+0.5*carriage_y"
        ),
    ),
    "axis without motor": (
        "generic_cartesian",
        "carriages: z\n",
        "carriages: x\n",
        "the [stepper NAME] sections do not move x, y and z independently; correct their 'carriages'",
    ),
    "axis without carriage": (
        "generic_cartesian",
        "[carriage z]",
        "[carriage w]\naxis: y",
        "[carriage w] is on axis y like the carriage of",
    ),
    "second carriage of a corexy": (
        "idex",
        "kinematics: cartesian",
        "kinematics: corexy",
        (
            "kinematics corexy has no place for [dual_carriage]; it needs cartesian, hybrid_corexy or"
            " hybrid_corexz, or generic_cartesian with [dual_carriage NAME]"
        ),
    ),
    "carriages that home into each other": (
        "idex",
        "safe_distance: 50 ",
        "safe_distance: 401 ",
        (
            "option 'safe_distance' of [dual_carriage] is '401', but after homing the carriages are 400"
            " mm apart, less than 401 mm; correct safe_distance, or position_endstop of one of them"
        ),
    ),
    "extruder with a gap": (
        "idex",
        "[extruder1]",
        "[extruder2]",
        "[extruder2] without [extruder1]: extruders count from [extruder] on",
    ),
    "follower of nothing": (
        "extruders",
        "extruder: extruder\n",
        "extruder: extruder7\n",
        (
            "option 'extruder' of [extruder_stepper feeder] is 'extruder7', but there is no such"
            " extruder; did you mean"
        ),
    ),
    "follower with its own advance": (
        "extruders",
        "extruder: extruder\n",
        "extruder: extruder\npressure_advance: 0.1\n",
        (
            "option 'pressure_advance' of [extruder_stepper feeder] is '0.1', but [extruder], whose"
            " motion it follows, has 0.04; one motion has one pressure advance: remove the option here"
        ),
    ),
    "extruder whose smooth time no step generation takes": (
        "extruders",
        "pressure_advance: 0.04\n",
        "pressure_advance: 0.04\npressure_advance_smooth_time: 0.00005\n",
        (
            "option 'pressure_advance_smooth_time' of [extruder] is '0.00005', must be a number in s, at"
            " least 0.0001 and at most 0.2"
        ),
    ),
    "the same of a follower": (
        "extruders",
        "extruder: extruder\n",
        "extruder: extruder\npressure_advance_smooth_time: 0.00005\n",
        "option 'pressure_advance_smooth_time' of [extruder_stepper feeder] is '0.00005', must be",
    ),
    "two steppers of one name": (
        "extruders",
        "[extruder_stepper feeder]",
        "[extruder_stepper extruder1]",
        "a stepper is named extruder1 here and at",
    ),
    "slow shaper": (
        "corexy",
        "shaper_freq_x: 50",
        "shaper_freq_x: 0.5",
        "option 'shaper_freq_x' of [input_shaper] is '0.5', must be 0 (not shaped) or at least 1 Hz",
    ),
    "long shaper": (
        "corexy",
        "shaper_freq_x: 50",
        "shaper_freq_x: 1\ndamping_ratio_x: 0.99",
        "option 'shaper_freq_x' of [input_shaper] is '1', is too low: mzv of 1 Hz with a damping",
    ),
    "unknown shaper": (
        "corexy",
        "shaper_type: mzv",
        "shaper_type: zvv",
        ("option 'shaper_type' of [input_shaper] is 'zvv', must be zv, mzv, zvd, ei, 2hump_ei or 3hump_ei"),
    ),
    "arms out of reach in the middle": (
        "rotary_delta",
        "position_endstop: 252",
        "position_endstop: 405",
        (
            "option 'position_endstop' of [stepper_a] is '405', where the arms do not reach in the"
            " middle; correct it, the arms or the shoulders"
        ),
    ),
}


@pytest.mark.parametrize(("name", "old", "new", "sentence"), BAD.values(), ids=BAD)
def test_one_sentence_for(tmp_path: Path, name: str, old: str, new: str, sentence: str) -> None:
    path = write(tmp_path, changed(old, new, example_text(name)))
    with pytest.raises(ConfigError) as error:
        load_machine(path)
    place, _, said = str(error.value).removeprefix(path).partition(": ")
    assert said.startswith(sentence)
    assert "\n" not in said
    assert place == "" or place[1:].isdigit()


AWKWARD = ("0", "-1", "99999", *(("1e-9", "1") if is_full() else ()))


@pytest.mark.parametrize("name", KINEMATICS.choices)
def test_whatever_number_stands_there_only_a_sentence_comes_back(tmp_path: Path, name: str) -> None:
    """Every number of every example, replaced by awkward ones."""
    lines = example_text(name).split("\n")
    for i, line in enumerate(lines):
        option, colon, value = line.partition(": ")
        if not colon or not value[:1].strip("-").isdigit():
            continue
        for awkward in AWKWARD:
            path = write(tmp_path, "\n".join([*lines[:i], f"{option}: {awkward}", *lines[i + 1 :]]))
            try:
                machine = load_machine(path)
            except ConfigError:
                continue
            assert all(math.isfinite(value) for value in machine.home)
            assert all(
                a <= b for a, b in zip(machine.limits.position_min, machine.limits.position_max, strict=True)
            )

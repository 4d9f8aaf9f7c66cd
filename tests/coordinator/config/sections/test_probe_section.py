"""[probe] as the machine reads it: the endstop of Z, and what cannot be."""

import re
from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.errors import ConfigError
from coordinator.config.model import PROBE_ENDSTOP, MachineDescription
from coordinator.support.examples import EXAMPLES
from tests.stages.probe_stage import OFFSET, machine_text


def load(folder: Path, text: str) -> MachineDescription:
    path = folder / "machine.cfg"
    path.write_text(text)
    return load_machine(str(path))


def test_z_is_homed_by_the_probe(tmp_path: Path) -> None:
    machine = load(tmp_path, machine_text())
    assert machine.unsupported == ()
    assert machine.probe is not None
    assert machine.probe.offset == OFFSET
    rail = machine.probe.rail
    assert rail is next(rail for rail in machine.rails if rail.axis == "z")
    assert (rail.homing.by_probe, rail.homing.virtual_endstop) == (True, PROBE_ENDSTOP)
    assert (rail.homing.position_endstop, rail.homing.positive_dir) == (OFFSET[2], False)
    assert [stop.axis for stop in machine.stops] == ["z"]
    assert machine.home[2] == OFFSET[2]


def test_beside_a_switch_it_is_an_endstop_of_its_own(tmp_path: Path) -> None:
    machine = load(tmp_path, machine_text(z={"endstop_pin": "PC7", "position_endstop": 2}))
    assert machine.probe is not None
    assert machine.probe.rail.axis == "probe"
    assert [(stop.axis, stop.homing.by_probe) for stop in machine.stops] == [("z", False), ("probe", True)]


def test_a_further_motor_of_z_names_the_same_endstop(tmp_path: Path) -> None:
    text = machine_text(further_z=1).replace(
        "[stepper_z1]\n", f"[stepper_z1]\nendstop_pin: {PROBE_ENDSTOP}\n"
    )
    machine = load(tmp_path, text)
    assert machine.unsupported == ()
    assert [stop.axis for stop in machine.stops] == ["z"]


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (f"pin: {PROBE_ENDSTOP}", f"pin: !{PROBE_ENDSTOP}", "takes no marks: put them before the pin of"),
        ("z_offset: 1.5", "z_offset: -4", "the z_offset of [probe], -4 mm, is outside position_min and"),
        ("position_min: -3", "position_endstop: 0", "but the z_offset of [probe] is where Z is; remove it"),
        ("position_min: -3", "homing_positive_dir: True", "but a probe is lowered to the bed; remove it"),
        ("z_offset: 1.5\n", "", "[probe] lacks option 'z_offset', a number in mm"),
        ("speed: 5\n", "speed: 0\n", "option 'speed' of [probe] is '0', must be a number in mm/s, above 0"),
        (
            "speed: 5\n",
            "samples: 0\n",
            "option 'samples' of [probe] is '0', must be a whole number, at least 1",
        ),
        ("speed: 5\n", "samples_result: best\n", "must be average or median"),
        ("speed: 5\n", "sped: 5\n", "[probe] has no option 'sped'; did you mean 'speed'?"),
        ("^toolhead:PC5", "PB6", "pin mcu:PB6 is already used for 'step_pin' of [stepper_z]"),
        ("^toolhead:PC5", "tool:PC5", "there is no node 'tool'"),
    ],
)
def test_mistakes(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    text = machine_text()
    assert old in text
    with pytest.raises(ConfigError, match=re.escape(sentence)):
        load(tmp_path, text.replace(old, new))


def test_it_is_an_endstop_of_z_alone(tmp_path: Path) -> None:
    text = machine_text().replace("[stepper_y]\n", f"[stepper_y]\nendstop_pin: {PROBE_ENDSTOP}\n")
    with pytest.raises(ConfigError, match=f"{PROBE_ENDSTOP} is an endstop of Z; give y a switch"):
        load(tmp_path, text)


def test_a_machine_whose_arms_swing_has_no_use_for_it(tmp_path: Path) -> None:
    text = (EXAMPLES / "rotary_delta.cfg").read_text() + "[probe]\npin: PH1\nz_offset: 1\n"
    with pytest.raises(ConfigError, match=r"\[probe\] has no use on a machine of kinematics rotary_delta"):
        load(tmp_path, text)


def test_towers_lower_the_head_as_motors_of_z_do(tmp_path: Path) -> None:
    machine = load(tmp_path, (EXAMPLES / "delta.cfg").read_text() + "[probe]\npin: PH1\nz_offset: 1\n")
    assert machine.unsupported == ()
    assert machine.probe is not None
    assert machine.probe.rail.axis == "probe"

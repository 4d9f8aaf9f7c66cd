"""[endstop_phase]: a switch that closes up to 20 µm off its place, and homing that is exact to the step."""

from pathlib import Path

import numpy as np
import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.errors import ConfigError
from coordinator.support.examples import EXAMPLES
from tests.stages.printer_text import section
from tests.stages.probe_stage import MICROSTEP_MM, ProbeStage, machine_text

NOISE_MM = 0.02
SWITCH = {"endstop_pin": "PC7", "position_endstop": 5}
DRIVER = section("tmc2209 stepper_z", uart_pin="PE8", run_current=0.8)
HOMINGS = 8


def make(
    folder: Path, sections: str, direction: str = "PB7", endstop_mm: float = 5, seed: int = 1
) -> ProbeStage:
    folder.mkdir(exist_ok=True)
    text = machine_text(z={**SWITCH, "position_endstop": endstop_mm}, sections=sections).replace(
        "dir_pin: PB7", f"dir_pin: {direction}"
    )
    assert f"dir_pin: {direction}" in text
    return ProbeStage(folder, text, switch_noise_mm=NOISE_MM, seed=seed)


def errors_mm(stage: ProbeStage, *lines: str, homings: int = HOMINGS) -> np.ndarray:
    """Home again and again; return how much higher the head is than the machine takes it for, each time."""
    found: list[float] = []

    def look() -> None:
        found.append(stage.true_mm("z") - 9.0)

    stage.on_echo["here"] = look
    stage.do(*["G28\nG1 Z9 F600\nM400\nM118 here"] * homings, *lines)
    return np.array(found)


@pytest.mark.parametrize("driver", [DRIVER, ""], ids=["told by the driver", "counted"])
@pytest.mark.parametrize("direction", ["PB7", "!PB7"])
@pytest.mark.parametrize("seed", [1, 2, 5])
def test_homing_repeats_to_the_step(tmp_path: Path, driver: str, direction: str, seed: int) -> None:
    without = errors_mm(make(tmp_path / "without", driver, direction, seed=seed))
    assert np.ptp(without) > 4 * MICROSTEP_MM, "the switch is that bad"
    by_phase = errors_mm(
        make(tmp_path / "with", driver + "[endstop_phase stepper_z]\n", direction, seed=seed)
    )
    assert np.ptp(by_phase) < 0.1 * MICROSTEP_MM


def test_the_phase_is_calibrated_and_kept(tmp_path: Path) -> None:
    stage = make(tmp_path / "first", DRIVER + "[endstop_phase]\n[endstop_phase stepper_z]\n")
    errors_mm(stage, "ENDSTOP_PHASE_CALIBRATE", "ENDSTOP_PHASE_CALIBRATE STEPPER=stepper_z")
    told = [text for text in stage.output if text.startswith("stepper_z: ")]
    assert told[0].startswith("stepper_z: 8 times homed, around phase ")
    assert stage.machine is not None
    kept = stage.machine.unsaved.pending["endstop_phase stepper_z"]["trigger_phase"]
    assert told[-1] == f"stepper_z: trigger_phase is {kept}; SAVE_CONFIG writes it"
    shown = stage.machine.modules.status()["endstop_phase"]["last_home"]
    assert isinstance(shown, dict)
    assert set(shown["stepper_z"]) == {"phase", "phases", "mcu_position"}
    # With that phase, homing is exact from the first time on; another one moves the place by as much.
    steps = []
    for number, shift in enumerate((0, 8)):
        phase, _, phases = kept.partition("/")
        written = f"{(int(phase) + shift) % int(phases)}/{phases}"
        sections = DRIVER + section("endstop_phase stepper_z", trigger_phase=written)
        steps.append(errors_mm(make(tmp_path / str(number), sections), homings=2) / MICROSTEP_MM)
    assert abs(steps[1] - steps[0]) == pytest.approx(8, abs=0.1)


@pytest.mark.parametrize("align", [True, False])
@pytest.mark.parametrize(("driver", "full_step"), [(DRIVER, 8), ("", 0)], ids=["told", "counted"])
@pytest.mark.parametrize("direction", ["PB7", "!PB7"])
@pytest.mark.parametrize("endstop_mm", [5.0, 5.0123])
def test_zero_is_at_a_full_step(
    tmp_path: Path, *, align: bool, driver: str, full_step: int, direction: str, endstop_mm: float
) -> None:
    """Which is where both coils have the same current: 8 of 16 phases of MSCNT, or as the driver began."""
    phase = section("endstop_phase stepper_z", trigger_phase="3/64", endstop_align_zero=align)
    stage = make(tmp_path, driver + phase, direction, endstop_mm)
    counts: list[int] = []

    def look() -> None:
        counts.append(stage.page("mcu").motors["stepper_z"].count)

    stage.on_echo["zero"] = look
    stage.do("G28", "G1 Z0 F600", "M400", "M118 zero")
    assert [count % 16 == full_step for count in counts] == [align], counts


def test_a_switch_that_is_worse_than_it_may_be_is_an_error(tmp_path: Path) -> None:
    sections = DRIVER + section("endstop_phase stepper_z", endstop_accuracy=0.01)
    with pytest.raises(Exception, match=r"the endstop of stepper_z switched at phase \d+/64 of its driver"):
        errors_mm(make(tmp_path, sections))


def test_what_is_not_known_is_told(tmp_path: Path) -> None:
    stage = make(tmp_path / "a", "[endstop_phase]\n")
    assert stage.do("ENDSTOP_PHASE_CALIBRATE")[-1] == "no axis was homed yet"
    with pytest.raises(Exception, match="no phase of 'stepper_y' is known"):
        make(tmp_path / "b", "[endstop_phase]\n").do("ENDSTOP_PHASE_CALIBRATE STEPPER=stepper_y")


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ("[endstop_phase stepper_x]\n", "names a stepper without an endstop on a pin"),
        ("[endstop_phase stepper_z]\ntrigger_phase: 64/64\n", "a phase and the number of phases"),
        ("[endstop_phase stepper_z]\ntrigger_phase: 7\n", "a phase and the number of phases"),
    ],
)
def test_a_wrong_section_is_refused(tmp_path: Path, written: str, said: str) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(machine_text(z=SWITCH, sections=written))
    with pytest.raises(ConfigError, match=said):
        load_machine(str(path))


def test_the_tower_of_a_delta_has_no_zero_to_align(tmp_path: Path) -> None:
    path = tmp_path / "printer.cfg"
    phase = section("endstop_phase stepper_a", endstop_align_zero=True)
    path.write_text((EXAMPLES / "delta.cfg").read_text(encoding="utf-8") + phase)
    with pytest.raises(ConfigError, match=r"'endstop_align_zero' .* is 'True', which is for X, Y and Z"):
        load_machine(str(path))

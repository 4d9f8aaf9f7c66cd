"""The bell rings when it should, on simulated boards: no hardware, no waiting."""

import asyncio
from pathlib import Path

import pytest

from coordinator.assembly.check import check_config
from coordinator.gcode.errors import GCodeError
from coordinator.gcode.program import Program
from coordinator.service.core.job_runner import run_job
from coordinator.simulate import scenario
from coordinator.simulate.stage import Stage

MACHINE = """
[mcu]
canbus_uuid: 90a4ae022dfc

[printer]
kinematics: cartesian
max_velocity: 250
max_accel: 3000

[stepper_x]
step_pin: PB0
dir_pin: PB1
microsteps: 16
rotation_distance: 40
position_max: 250

[stepper_y]
step_pin: PB3
dir_pin: PB4
microsteps: 16
rotation_distance: 40
position_max: 250

[stepper_z]
step_pin: PB6
dir_pin: PB7
microsteps: 16
rotation_distance: 8
position_max: 250
"""
CHIME = "\n[chime]\npin: PC0\nlength: 0.5\n"


def ring(folder: Path, *lines: str) -> list[tuple[float, int]]:
    """Run a program; return when the bell's pin changed, in s from the first time, and to what."""
    (folder / "chime.cfg").write_text(MACHINE + CHIME)
    (folder / "chime.toml").write_text('about = "A bell."\nmachine = "chime.cfg"\n')
    stage = Stage(scenario.find(str(folder / "chime.toml")), seed=0)

    async def go() -> None:
        program = Program.from_lines(lines, "part.gcode")
        await run_job(stage.description, program, lambda _: None, on_output=lambda _: None, host=stage.host)

    with asyncio.Runner(loop_factory=stage.make_loop) as runner:
        runner.run(go())
    edges = stage.edges("mcu")
    own = edges[edges["pin"] == stage.pins("mcu")["PC0"]]
    own = own[own["level"].nonzero()[0][0] :]
    return [(float(edge["true_ps"] - own["true_ps"][0]) * 1e-12, int(edge["level"])) for edge in own]


def test_it_rings_for_as_long_as_it_is_told(tmp_path: Path) -> None:
    edges = ring(tmp_path, "CHIME", "G28", "G1 X100 F6000", "CHIME LENGTH=0.1", "G1 X200")
    assert [level for _, level in edges] == [1, 0, 1, 0]
    times = [time_s for time_s, _ in edges]
    assert times[1] == pytest.approx(0.5, abs=1e-3)
    assert times[3] - times[2] == pytest.approx(0.1, abs=1e-3)


@pytest.mark.parametrize("word", ["LENGTH=6", "LENGTH=0", "LENGTH=long", "LENGTH=nan"])
def test_a_length_that_cannot_be_ends_the_program_with_the_line(tmp_path: Path, word: str) -> None:
    with pytest.raises(GCodeError, match=r"^part\.gcode:2: LENGTH of CHIME is .*from 0\.01 to 5"):
        ring(tmp_path, "G28", f"CHIME {word}")


def test_what_is_wrong_in_its_section_is_told(tmp_path: Path) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(MACHINE + "[chime]\npni: PC0\nlength: 9\n")
    told = [str(problem).removeprefix(f"{path}:") for problem in check_config(str(path))]
    assert len(told) == 3
    assert "lacks option 'pin'" in told[0]
    assert "has no option 'pni'; did you mean 'pin'?" in told[1]
    assert "must be a number in s, at least 0.01 and at most 5" in told[2]

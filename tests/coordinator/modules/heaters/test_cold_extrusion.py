"""Filament is not moved while its extruder is cold; a program that is only planned knows no cold."""

import asyncio
from pathlib import Path

import pytest

from coordinator.gcode.commands import Vocabulary
from coordinator.gcode.errors import GCodeError
from coordinator.gcode.interpreter import Job
from coordinator.gcode.program import Program
from coordinator.modules.module_set import build_modules
from coordinator.motion.planner.planner import Planner
from coordinator.service.core.motion import Motion
from coordinator.service.core.work import FileWork
from coordinator.streaming.program_machine import machine_state
from tests.coordinator.motion.planner_helpers import drain
from tests.stages.heat_machine import HeatMachine
from tests.stages.program_stage import events_of

HEATER = "control: pid\npid_kp: 10\npid_ki: 1\npid_kd: 15\nmin_extrude_temp: 120\n"


def job(stage: HeatMachine, vocabulary: Vocabulary, *lines: str) -> Job:
    described = stage.description
    program = Program.from_lines(lines, "part.gcode")
    home = described.homed_position
    return Job(program, Planner(described.limits), home, machine_state(described), vocabulary)


async def play(stage: HeatMachine, *lines: str) -> None:
    motion = Motion(stage.machine, on_output=lambda _: None, on_cycle=lambda: None)
    queued = motion.feeder.submit(FileWork(Program.from_lines(lines, "part.gcode")))
    motion.finish()
    await motion.run()
    if queued.error is not None:
        raise queued.error


@pytest.mark.parametrize("line", ["G1 E1 F300", "G1 X10 E0.5 F3000", "G1 E-1 F300"])
def test_a_cold_extruder_refuses_filament(tmp_path: Path, line: str) -> None:
    stage = HeatMachine(tmp_path, HEATER)

    async def main() -> None:
        await asyncio.sleep(1)
        with pytest.raises(GCodeError, match=r"part\.gcode:3: .*colder than its min_extrude_temp"):
            await play(stage, "G28", "G1 X5 F3000", line)
        assert stage.machine.stopped is None

    stage.connected(main)


def test_a_hot_one_takes_it_in_the_same_program(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HEATER, hurry=3)

    async def main() -> None:
        await play(
            stage,
            "M104 S150",
            "TEMPERATURE_WAIT SENSOR=extruder MINIMUM=140",
            "G28",
            "G1 X10 E0.5 F3000",
            "M104 S0",
        )
        assert stage.status("extruder")["target"] == 0
        await stage.do("TEMPERATURE_WAIT SENSOR=extruder MAXIMUM=100")
        with pytest.raises(GCodeError, match="min_extrude_temp"):
            await play(stage, "G28", "G1 X10 E0.5 F3000")

    stage.connected(main)


def test_a_plan_is_never_cold(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HEATER)
    described = stage.description
    vocabulary = build_modules(described).vocabulary
    work = job(stage, vocabulary, "G28", "M109 S200", "G1 X10 E0.5 F3000")
    events_of(work, lambda: drain(work.planner))
    assert work.planner.moves == 1
    work.planner.cold = True
    assert work.planner.cold

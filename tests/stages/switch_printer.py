"""A machine on simulated boards whose axes stand some way from their switches, judged by the steps made."""

import asyncio
from dataclasses import dataclass, field
from pathlib import Path

from coordinator.gcode.program import Program
from coordinator.service.core.job_runner import run_job
from coordinator.service.jobs.outcome import Outcome
from coordinator.simulate import scenario as scenarios
from coordinator.simulate.stage import Stage
from coordinator.streaming.move_source import ProgramOutput
from tests.stages.motor_switches import MotorSwitch, place_switches
from tests.stages.printer_text import SWITCHES_CFG

STEPS_PER_MM = {"x": 80, "y": 80, "z": 400}
PINS = {"x": ("PB0", "PB1", 1), "y": ("PB3", "PB4", -1), "z": ("PB6", "PB7", 1)}
"""Step pin, direction pin, and whether a high direction pin means forwards (1) or backwards (-1)."""


@dataclass
class SwitchPrinter:
    """A machine whose axes stand some way from their switches: DISTANCE_MM, signed along the axis."""

    folder: Path
    distance_mm: dict[str, float]
    machine: str = SWITCHES_CFG
    settings: str = ""
    seed: int = 0
    output: list[str] = field(default_factory=list)

    def run(self, *lines: str) -> Outcome:
        (self.folder / "home.cfg").write_text(self.machine)
        (self.folder / "home.toml").write_text(f'about = "G28."\nmachine = "home.cfg"\n{self.settings}')
        self.stage = Stage(scenarios.find(str(self.folder / "home.toml")), self.seed)
        switches = []
        for axis, mm in self.distance_mm.items():
            step, direction, sign = PINS[axis]
            switches.append(
                MotorSwitch(
                    step,
                    direction,
                    node="toolhead" if axis == "x" else "mcu",
                    pin={"x": "PC5", "y": "PC6", "z": "PC7"}[axis],
                    at=sign * round(mm * STEPS_PER_MM[axis]),
                    direction=sign * (1 if mm > 0 else -1),
                )
            )
        place_switches(self.stage, switches)
        with asyncio.Runner(loop_factory=self.stage.make_loop) as runner:
            return runner.run(self._main(lines))

    async def _main(self, lines: tuple[str, ...]) -> Outcome:
        return await run_job(
            self.stage.description,
            Program.from_lines(lines, "part.gcode"),
            on_output=self._tell,
            host=self.stage.host,
        )

    def _tell(self, output: ProgramOutput) -> None:
        self.output.append(output.text)

    def true_mm(self, axis: str, endstop_mm: float) -> float:
        """Return where an axis is, with its switch at ENDSTOP_MM, by the steps that were made."""
        step, direction, sign = PINS[axis]
        pins = self.stage.pins("mcu")
        edges = self.stage._boards["mcu"].node.edges()
        level, steps = 0, 0
        for pin, high in zip(edges["pin"], edges["level"], strict=True):
            if pin == pins[direction]:
                level = int(high)
            elif pin == pins[step] and high:
                steps += 1 if level else -1
        return endstop_mm + sign * steps / STEPS_PER_MM[axis] - self.distance_mm[axis]

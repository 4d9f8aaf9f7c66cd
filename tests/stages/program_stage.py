"""A machine of a few lines with the modules under test, and programs that it reads; no hardware."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from coordinator.assembly.load import load_machine
from coordinator.gcode.errors import GCodeError
from coordinator.gcode.events import Done, End, Event, Full, Notice, Progress, Reply, StandstillAction
from coordinator.gcode.interpreter import Job
from coordinator.gcode.program import Program
from coordinator.modules.module_set import build_modules
from coordinator.motion.planner.planner import Planner
from coordinator.motion.trapezoid_array import array_of
from coordinator.streaming.program_machine import machine_state
from tests.stages.printer_text import PRINTER_CFG, write

if TYPE_CHECKING:
    from coordinator.gcode.machine_state import MachineState
    from coordinator.modules.module_set import ModuleSet


def events_of(
    job: Job, drain: Callable[[], object], perform: Callable[[StandstillAction], None] | None = None
) -> list[Event]:
    """Run JOB to its end, with DRAIN after each step; return its events but for progress.

    What is done at standstill succeeds unless PERFORM says what comes of it.
    """
    found: list[Event] = []
    while not (found and isinstance(found[-1], End)):
        event = job.step()
        drain()
        if isinstance(event, StandstillAction):
            assert job.planner.at_standstill
            if perform is not None:
                perform(event)
            elif event.done is None:
                event.done = Done()
        if not isinstance(event, Progress | Full):
            found.append(event)
    return found


class ProgramStage:
    """MACHINE with SECTIONS added to its configuration; programs run one after the other."""

    def __init__(self, folder: Path, sections: str = "", machine: str = PRINTER_CFG) -> None:
        self.path = write(folder, machine + "\n" + sections)
        self.description = load_machine(self.path)
        self.modules: ModuleSet = build_modules(self.description)
        self.planner = Planner(self.description.limits)
        self.machine: MachineState = machine_state(self.description)
        self.moves: list[tuple[float, ...]] = []
        """Starts of all moves (X Y Z E, mm), each with its ratios."""

    def job(self, *lines: str) -> Job:
        self.planner.lines = 0
        return Job(
            Program.from_lines(lines, "part.gcode"),
            self.planner,
            self.description.homed_position,
            self.machine,
            self.modules.vocabulary,
        )

    def events(self, *lines: str, perform: Callable[[StandstillAction], None] | None = None) -> list[Event]:
        """Run a program to its end; what is done at rest succeeds unless PERFORM says what comes of it."""
        job = self.job(*lines)
        return events_of(job, self._drain, perform)

    def run(self, *lines: str) -> list[str]:
        """Run a program to its end; return its replies."""
        return [event.text for event in self.events(*lines) if isinstance(event, Reply)]

    def notices(self, *lines: str) -> list[str]:
        return [event.text for event in self.events(*lines) if isinstance(event, Notice)]

    def error(self, *lines: str) -> str:
        """Run a program that has to end in an error; return its sentence."""
        with pytest.raises(GCodeError) as error:
            self.run(*lines)
        return str(error.value)

    def _drain(self) -> None:
        while (waiting := self.planner.take()).count:
            for move in array_of(waiting):
                ratio = [round(float(r), 9) for r in move["ratio"]]
                self.moves.append(tuple(float(v) for v in move["start"]) + tuple(ratio))
            self.planner.release(waiting.count)

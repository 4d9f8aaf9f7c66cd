"""The demo's machine of three nodes on simulated boards, and ``canductor run`` on it in virtual time.

Nothing presses endstops: G28 takes the axes as home where they are, so that every step is one of the program.
"""

import asyncio
from collections.abc import Callable, Coroutine, Mapping
from pathlib import Path
from typing import Any

from coordinator.cli.commands.run import RunOptions, RunReport, run_machine
from coordinator.gcode.program import Program
from coordinator.service.core.job_runner import run_job
from coordinator.service.jobs.outcome import Outcome
from coordinator.simulate.scenario import BusSetting, NodeSetting
from tests.stages.machine_stage import MachineStage
from tests.stages.printer_text import without_endstops
from tests.stages.served import Served, running

SQUARE = """\
G28
G90
M82
G92 E0
G1 Z0.3 F600
G1 X20 Y20 F9000
G1 X40 Y20 E1 F3000
G1 X40 Y40 E2
G1 X20 Y40 E3
G1 X20 Y30 E4
G1 Z0.6 F600
"""
"""Every stepper of the demo machine moves, both ways where it can; two seconds."""
NODES = ("mcu", "toolhead", "zboard")


class Typed:
    """Standard input of a program in virtual time: lines come when ``type`` is called."""

    def __init__(self) -> None:
        self._waiting = b""
        self._over = False

    def type(self, *lines: str) -> None:
        """Let LINES come."""
        self._waiting += "".join(line + "\n" for line in lines).encode()

    def end(self) -> None:
        """Close it."""
        self._over = True

    def read(self, size: int, /) -> bytes | None:
        piece, self._waiting = self._waiting[:size], self._waiting[size:]
        return piece if piece or self._over else None

    def close(self) -> None:
        """Nothing is held."""


class TypedRun:
    """A program that is typed while it runs, what it answers, and its outcome."""

    def __init__(self, machine: "DemoMachine") -> None:
        self.told: list[str] = []
        self._input = Typed()
        self._job = asyncio.ensure_future(
            run_job(
                machine.description,
                Program(self._input, "standard input"),
                on_output=lambda told: self.told.append(told.text),
                host=machine.host,
            )
        )

    async def type(self, *lines: str, answer: str = "") -> None:
        """Type LINES; wait for an answer with these words in it, unless there are none."""
        self._input.type(*lines)
        while answer and not any(answer in line for line in self.told):
            assert not self._job.done(), (answer, self.told)
            await asyncio.sleep(0.01)

    async def end(self) -> Outcome:
        """Close the input and wait for the end; raises what the job does."""
        self._input.end()
        return await self._job


class DemoMachine(MachineStage):
    """The demo's machine, its configuration in FOLDER with CHANGES (words by words) and SECTIONS added."""

    def __init__(
        self,
        folder: Path,
        *,
        seed: int = 1,
        nodes: Mapping[str, NodeSetting] | None = None,
        buses: Mapping[str, BusSetting] | None = None,
        changes: Mapping[str, str] | None = None,
        sections: str = "",
    ) -> None:
        self.folder = folder
        config = folder / "machine.cfg"
        config.write_text(without_endstops(changes=changes) + sections, encoding="utf-8")
        super().__init__(config, seed=seed, nodes=nodes, buses=buses)

    def write_config(self, name: str, changes: Mapping[str, str] | None = None) -> Path:
        """Write another configuration for the same boards."""
        path = self.folder / name
        path.write_text(without_endstops(changes=changes), encoding="utf-8")
        return path

    def write_gcode(self, text: str | bytes, name: str = "job.gcode") -> Path:
        path = self.folder / name
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    def print(self, text: str | bytes, config: Path | None = None) -> RunReport:
        """Print a file as ``canductor run --gcode`` does; raises as it does."""
        options = RunOptions(config=config or self.config, gcode=self.write_gcode(text), json=True)
        return run_machine(options, self.host)

    def typed(self, main: Callable[[TypedRun], Coroutine[Any, Any, Outcome]]) -> tuple[Outcome, list[str]]:
        """Run what MAIN types; return the outcome and all answers."""

        async def run() -> tuple[Outcome, list[str]]:
            typing = TypedRun(self)
            return await main(typing), typing.told

        return self.run(run)

    def serve(self, *mains: Callable[[Served], Coroutine[Any, Any, None]], **options: Any) -> None:
        """Run each of MAINS with a service of its own, one after the other; OPTIONS as Served."""

        async def run() -> None:
            for main in mains:
                served = Served(self.folder, lambda: self.description, self.host, **options)
                async with running(served):
                    await main(served)

        self.run(run)

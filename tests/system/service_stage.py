"""A machine service in this process, on virtual nodes in processes of their own, called as a client would."""

import asyncio
import inspect
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from coordinator.host import LinuxHost
from coordinator.ipc.methods import Caller, Registry, Scope
from coordinator.ipc.state import StateTree
from coordinator.machine.description import load_machine
from coordinator.motion.steps import resting_step
from coordinator.service.machine_service import MachineService, ServiceSettings
from coordinator.service.methods import add_methods
from tests.system.stage import Hardware

LIMIT_S = 60.0
"""Nothing here may take longer; most takes a fifth of it."""


class Served:
    """A service that runs, and how to call it."""

    def __init__(self, hardware: Hardware, *, node_commands: bool = False) -> None:
        self.jobs = hardware.folder / "jobs"
        self.jobs.mkdir(exist_ok=True)
        self.tree = StateTree()
        self.lines: list[str] = []
        settings = ServiceSettings(name="test", jobs=self.jobs, node_commands=node_commands)
        self.service = MachineService(
            lambda: load_machine(str(hardware.config)),
            LinuxHost(),
            self.tree,
            settings,
            on_line=lambda entry: self.lines.append(str(entry["text"])),
        )
        self._registry = Registry()
        add_methods(self.service, self._registry)

    async def call(self, name: str, **params: Any) -> dict[str, Any]:
        """Call a method as the server does."""
        method = self._registry.methods[name]
        answer = method.call(Caller("a test", Scope.ADMIN), method.check(params))
        if inspect.isawaitable(answer):
            answer = await answer
        assert isinstance(answer, dict)
        return answer

    def write_job(self, text: str, name: str = "job.gcode") -> str:
        """Put a file into the job folder."""
        (self.jobs / name).write_text(text, encoding="utf-8")
        return name

    async def until(self, true: Callable[[], bool], what: str) -> None:
        """Wait until TRUE, looking as often as the state changes."""
        async with asyncio.timeout(LIMIT_S):
            while not true():
                assert self.service.state != "error" or what == "error", self.service.cause
                await asyncio.sleep(0.01)

    async def until_state(self, state: str) -> None:
        await self.until(lambda: str(self.service.state) == state, state)

    async def until_job(self, *phases: str) -> None:
        await self.until(lambda: self.job_state in phases, f"job {phases}")

    @property
    def job_state(self) -> str:
        job = self.service.job
        return "none" if job is None else str(job.phase)

    async def check_positions(self, homed_at: dict[str, int] | None = None) -> dict[str, int]:
        """Make sure that every stepper stands where the plan says, by its node's count; return the counts.

        HOMED_AT: the counts when the machine was declared to stand at 0; None: at its start.
        """
        told = await self.call("position.get", ask_nodes=True)
        assert self.service.motion is not None
        assert self.service.machine is not None
        planned = self.service.motion.planned.position
        specs = self.service.machine.devices.stepper_specs()
        began = homed_at or dict.fromkeys((spec.name for spec in specs), 0)
        expected = {spec.name: began[spec.name] + resting_step(spec, (0.0,) * 4, planned) for spec in specs}
        counted = told["nodes_steps"]
        assert isinstance(counted, dict)
        sent = {name: stepper["steps_sent"] for name, stepper in told["steppers"].items()}
        assert counted == sent == expected
        return dict(counted)


@asynccontextmanager
async def served(hardware: Hardware, *, node_commands: bool = False) -> AsyncIterator[Served]:
    """Run a service on HARDWARE; READY when the block begins."""
    stage = Served(hardware, node_commands=node_commands)
    life = asyncio.ensure_future(stage.service.run())
    try:
        await stage.until_state("ready")
        yield stage
    finally:
        life.cancel()
        ended = await asyncio.gather(life, return_exceptions=True)
    assert isinstance(ended[0], asyncio.CancelledError), ended


def outside(folder: Path) -> Path:
    """Return a file beside the job folder."""
    path = folder / "secret.gcode"
    path.write_text("G28\n", encoding="utf-8")
    return path

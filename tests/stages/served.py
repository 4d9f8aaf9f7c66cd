"""A machine service in virtual time, called as a client would."""

import asyncio
import inspect
import random
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from coordinator.config.model import MachineDescription
from coordinator.ipc.protocol.methods import Caller, Registry, Scope
from coordinator.ipc.server.state import StateTree
from coordinator.ipc.server.uploads import upload_method
from coordinator.motion.planner.planner import Position
from coordinator.runtime.host import Host
from coordinator.service.api.methods import add_methods
from coordinator.service.core.machine_service import MachineService, ServiceSettings
from coordinator.service.state.log_ring import Entry
from tests.stages.resting_step import resting_step

LIMIT_S = 60.0
"""Nothing here may take longer, in virtual time."""
LOOK_S = 0.03
"""How often it is looked whether something is true that is waited for."""


def zigzag(moves: int, seed: int) -> str:
    """Return a job of short moves in all axes, at random, with extrusion; some tenth of a second each."""
    chance = random.Random(seed)
    lines = ["G28", "G90", "M83", "G1 Z1 F900", "G1 X50 Y50 F6000"]
    for _ in range(moves):
        x, y = chance.uniform(20, 80), chance.uniform(20, 80)
        lines.append(f"G1 X{x:.3f} Y{y:.3f} E{chance.uniform(0, 1):.4f} F{chance.randrange(9000, 15000)}")
    return "\n".join(lines) + "\n"


class Served:
    """A service that runs, and how to call it."""

    def __init__(
        self,
        folder: Path,
        load: Callable[[], MachineDescription],
        host: Host,
        *,
        node_commands: bool = False,
        tables: Path | None = None,
        own_process: bool = False,
    ) -> None:
        self.jobs = folder / "jobs"
        self.jobs.mkdir(exist_ok=True)
        self.tree = StateTree()
        self.lines: list[str] = []
        settings = ServiceSettings(
            name="test",
            jobs=self.jobs,
            node_commands=node_commands,
            tables=tables,
            state=folder / "state",
            own_process=own_process,
        )
        self.listeners: list[Callable[[Entry], None]] = []
        """Hear every line of the log, too."""
        self.service = MachineService(load, host, self.tree, settings, on_line=self._hear)
        self.registry = Registry()
        self._homed: tuple[dict[str, int], Position] = ({}, (0.0,) * 4)
        add_methods(self.service, self.registry)
        self.registry.add(upload_method(self.jobs))

    def _hear(self, entry: Entry) -> None:
        self.lines.append(str(entry["text"]))
        for listener in self.listeners:
            listener(entry)

    async def call(self, name: str, /, **params: Any) -> dict[str, Any]:
        """Call a method as the server does."""
        method = self.registry.methods[name]
        answer = method.call(Caller("a test", Scope.ADMIN), method.check(params))
        if inspect.isawaitable(answer):
            answer = await answer
        assert isinstance(answer, dict)
        return answer

    def write_job(self, text: str, name: str = "job.gcode") -> str:
        """Put a file into the job folder."""
        (self.jobs / name).write_text(text, encoding="utf-8")
        return name

    async def until(self, true: Callable[[], bool], what: str, limit_s: float = LIMIT_S) -> None:
        """Wait until TRUE, looking as often as the state changes."""
        try:
            async with asyncio.timeout(limit_s):
                while not true():
                    assert self.service.state != "error" or what == "error", self.service.cause
                    await asyncio.sleep(LOOK_S)
        except TimeoutError:
            told = (str(self.service.state), self.job_state, self.tree.get("job.line"), self.lines[-5:])
            raise AssertionError(f"{what} did not come within {limit_s} s: {told}") from None

    async def until_state(self, state: str) -> None:
        await self.until(lambda: str(self.service.state) == state, state)

    async def until_job(self, *phases: str, limit_s: float = LIMIT_S) -> None:
        """Wait until the job is in one of PHASES; fails at once when it has come to another end."""

        def reached() -> bool:
            job = self.service.job
            assert job is None or job.active or job.phase in phases, (job.phase, job.message, self.lines[-5:])
            return self.job_state in phases

        await self.until(reached, f"job {phases}", limit_s)

    @property
    def job_state(self) -> str:
        job = self.service.job
        return "none" if job is None else str(job.phase)

    async def homing_comes(self) -> None:
        """Take note of where the steppers are now, when G28 will declare X Y Z to be 0."""
        counted = await self.check_positions()
        self._homed = (counted, (0.0, 0.0, 0.0, self.planned[3]))

    @property
    def planned(self) -> Position:
        """Where the last move ends."""
        assert self.service.motion is not None
        return self.service.motion.planned.state.toolhead_position

    async def check_positions(self) -> dict[str, int]:
        """Make sure that every stepper stands where the plan says, by its node's count; return the counts."""
        told = await self.call("position.get", ask_nodes=True)
        assert self.service.machine is not None
        specs = self.service.machine.devices.stepper_specs()
        counts, position = self._homed
        expected = {s.name: counts.get(s.name, 0) + resting_step(s, position, self.planned) for s in specs}
        counted = told["nodes_steps"]
        assert isinstance(counted, dict)
        sent = {name: stepper["steps_sent"] for name, stepper in told["steppers"].items()}
        assert counted == sent == expected, (counted, sent, expected)
        return dict(counted)


@asynccontextmanager
async def running(stage: Served) -> AsyncIterator[Served]:
    """Run STAGE's service; READY when the block begins."""
    life = asyncio.ensure_future(stage.service.run())
    try:
        await stage.until_state("ready")
        yield stage
    finally:
        life.cancel()
        ended = await asyncio.gather(life, return_exceptions=True)
    assert isinstance(ended[0], asyncio.CancelledError), ended

"""Restarts of a served machine after all kinds of disturbances, drawn from one seed.

In each round a client prints, homes, heats, stops and restarts while wires, nodes and the host are disturbed.
Then all is sound again, and plain restarts follow until the machine is ready: the first one has to be enough.

    python -m tests.sim.restarts 0:1000
"""

import asyncio
import contextlib
import random
import sys
import tempfile
from collections.abc import Coroutine
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from coordinator.assembly.load import load_machine
from coordinator.ipc.protocol.methods import ApiError
from coordinator.service.state.log_ring import Entry
from coordinator.simulate.faults import NS
from coordinator.simulate.scenario import NodeSetting
from coordinator.support.toml_values import Range
from coordinator.virtual_machine.plant import PlantSettings
from nodes.support.errors import CanductorError
from tests.stages.machine_stage import MachineStage
from tests.stages.served import Served

MACHINES: Final = (
    *(f"coordinator/simulate/machines/{name}.cfg" for name in ("pair", "trio", "heated", "quad")),
    *(f"coordinator/simulate/machines/{name}.cfg" for name in ("optional", "pause", "many")),
    *(f"tests/stages/machines/{name}.cfg" for name in ("homing", "safety")),
    *(f"config/{name}.cfg" for name in ("demo/machine", "corexy_toolhead", "cartesian_uart", "sensorless")),
)
JOB: Final = "G28\n" + "G1 X100 F6000\nG1 X20 F6000\n" * 500
SCRIPTS: Final = ("G28\nG1 X20 F6000", "M104 S210", "M140 S60", "M106 S200", "M84")
FAULTS: Final = ("cut", "reset", "power", "stall", "loss", "corruption", "errors", "flood", "host", "loop")
ROUNDS: Final = 4
TRIES: Final = 6
BOOT_S: Final = 1.5
LOOK_S: Final = 0.03
LIMIT_S: Final = 200.0
"""For a restart and what it waits for."""


@dataclass
class Found:
    """What came out with one seed."""

    seed: int
    machine: str
    restarts: list[int] = field(default_factory=list)
    """By round: how many it took."""
    log: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether the first restart was enough, in every round."""
        return self.restarts == [1] * ROUNDS


class RestartSearch:
    """One machine, its configuration in FOLDER; SEED decides everything."""

    def __init__(self, folder: Path, seed: int) -> None:
        self._chance = chance = random.Random(seed)
        self.found = Found(seed, chance.choice(MACHINES))
        self._folder = folder
        self._config = folder / "printer.cfg"
        self._config.write_text(Path(self.found.machine).read_text())
        self._names = [node.name for node in load_machine(str(self._config)).nodes]
        self._stage = MachineStage(self._config, seed=seed, nodes=self._nodes(), plant=PlantSettings())
        self._buses = [wire.name for wire in self._stage.stage.wires()]
        self._sound_ns = 0
        self._refused = ""
        self._calls: set[asyncio.Task[None]] = set()
        self._served: Served
        self._life: asyncio.Future[None]

    def _nodes(self) -> dict[str, NodeSetting]:
        chance = self._chance
        legacy = chance.random() < 0.15
        reset = chance.choice(("clears", "clears", "unknown", "unknown"))
        return {
            name: NodeSetting(
                legacy=legacy,
                config_reset=reset,
                rollover_after_s=Range(0, chance.choice((3.0, 20.0, 85.0))),
                latency_us=Range(0, chance.choice((40, 40, 2000))),
                boot_s=Range(chance.choice((0.002, 0.5)), chance.choice((0.5, BOOT_S))),
            )
            for name in self._names
        }

    def run(self) -> Found:
        """Run all rounds."""
        self._stage.run(self._main)
        return self.found

    def _note(self, text: str) -> None:
        self.found.log.append(f"{self._stage.now_s():.3f} {text}")

    def _hear(self, entry: Entry) -> None:
        if entry["kind"] in ("state", "notice"):
            self._note(f"  {entry['text']}")

    async def _main(self) -> None:
        await asyncio.sleep(BOOT_S + 0.1)
        self._begin()
        for _ in range(ROUNDS):
            for _ in range(self._chance.randint(1, 5)):
                if self._chance.random() < 0.5:
                    self._disturb()
                else:
                    await self._act()
                await asyncio.sleep(self._pause_s())
            if self._chance.random() < 0.15:
                await self._end()
                self._begin()
            self.found.restarts.append(await self._restarts())
        await self._end()

    def _pause_s(self) -> float:
        chance = self._chance
        longest_s = chance.choice((5.0, 5.0, 5.0, 30.0, 100.0))
        return chance.choice((0.0, 0.001, 0.03, 0.3, 1.0, chance.uniform(0, longest_s)))

    def _begin(self) -> None:
        self._note("a service begins")
        self._served = Served(self._folder, lambda: load_machine(str(self._config)), self._stage.host)
        self._served.listeners.append(self._hear)
        self._served.write_job(JOB)
        self._life = asyncio.ensure_future(self._served.service.run())

    async def _end(self) -> None:
        self._life.cancel()
        await asyncio.gather(self._life, *self._calls, return_exceptions=True)
        assert self._life.cancelled()

    # ---------------------------------------------------------------------------------------------- a round

    def _disturb(self) -> None:
        chance, stage = self._chance, self._stage
        kind, node, bus = chance.choice(FAULTS), chance.choice(self._names), chance.choice(self._buses)
        is_line = bus.startswith("/")
        at_s = chance.choice((0.0, chance.uniform(0, 3)))
        for_s = chance.choice((0.02, 0.1, 0.4, 0.9, 1.1, 1.6, chance.uniform(0, 3)))
        share, data = chance.choice((0.05, 0.3, 1.0)), chance.choice((b"", b"\x7e", b"\x40"))
        if is_line if kind == "errors" else kind == "flood" and not is_line:
            return
        self._note(f"{kind} of {node}, {bus}, in {at_s:.3f} s for {for_s:.3f} s, {share}")
        if kind in ("host", "loop"):
            stage.at(at_s, lambda: stage.stage.stall(for_s, io=kind == "host"))
        else:
            where = {"bus": bus} if kind in ("loss", "corruption", "errors", "flood") else {"node": node}
            stage.stage.faults.add(kind, at_s=at_s, for_s=for_s, share=share, data=data, **where)
        end_ns = stage.stage.now_ns() + round((at_s + for_s + BOOT_S + 0.1) * NS)
        self._sound_ns = max(self._sound_ns, end_ns)

    async def _act(self) -> None:
        what = self._chance.choices(("job", "script", "stop", "restart"), (25, 20, 25, 30))[0]
        self._note(what)
        if what == "script":
            script = self._chance.choice(SCRIPTS)
            task = asyncio.ensure_future(self._try(self._served.call("gcode.run", script=script)))
            self._calls.add(task)
            task.add_done_callback(self._calls.discard)
        elif what == "job":
            await self._try(self._served.call("job.start", file="job.gcode"))
        elif what == "stop":
            await self._try(self._served.call("machine.emergency_stop"))
        else:
            await self._try(self._served.call("machine.restart"))

    async def _try(self, call: Coroutine[Any, Any, Any]) -> None:
        try:
            await call
        except CanductorError as error:
            self._note(f"refused: {error}")

    async def _restarts(self) -> int:
        """Return how many plain restarts it takes with all sound again; the machine has to remain ready."""
        stage, chance = self._stage, self._chance
        sound_s = max(0.0, (self._sound_ns - stage.stage.now_ns()) / NS)
        await asyncio.sleep(sound_s + chance.choice((0.0, 0.001, 0.05, 0.3, 1.0, 3.0)))
        for number in range(1, TRIES):
            try:
                async with asyncio.timeout(LIMIT_S):
                    await self._started(0)
                    starts = self._served.service.starts
                    await self._restart()
                    await self._started(starts)
            except TimeoutError:
                self._note(f"nothing for {LIMIT_S:g} s: {self._served.service.state}")
                return TRIES
            self._note(f"restart {number}: {self._served.service.state} {self._served.service.cause}")
            await asyncio.sleep(chance.choice((0.0, 0.5, 6.0)))
            if str(self._served.service.state) == "ready":
                return number
        return TRIES

    async def _started(self, before: int) -> None:
        """Wait for the end of a start after those BEFORE."""
        service = self._served.service
        while True:
            await asyncio.sleep(LOOK_S)
            if service.starts > before and str(service.state) != "startup":
                return

    async def _restart(self) -> None:
        """Restart plainly, as soon as that is accepted."""
        while True:
            with contextlib.suppress(ApiError):
                if self._served.service.active_job is not None:
                    await self._served.call("job.cancel")
            try:
                await self._served.call("machine.restart")
            except ApiError as error:
                refused = str(error)
            else:
                return
            if refused != self._refused:
                self._refused = refused
                self._note(f"restart refused: {refused}")
            await asyncio.sleep(LOOK_S)


def search(seed: int) -> Found:
    """Run one seed."""
    with tempfile.TemporaryDirectory() as folder:
        return RestartSearch(Path(folder), seed).run()


def main() -> None:
    """Run many."""
    first, last = map(int, sys.argv[1].split(":"))
    rounds = failed = 0
    for seed in range(first, last):
        found = search(seed)
        rounds += len(found.restarts)
        failed += not found.ok
        if not found.ok or last == first + 1:
            sys.stdout.write("\n".join([f"{seed} {found.machine} {found.restarts}", *found.log, ""]))
            sys.stdout.flush()
    sys.stdout.write(f"{last - first} seeds, {rounds} rounds, {failed} seeds failed\n")


if __name__ == "__main__":
    main()

"""Figures of a machine's buses, whenever somebody asks."""

import asyncio
from pathlib import Path

from coordinator.modules.module_set import build_modules
from coordinator.runtime.machine import Machine
from coordinator.virtual_machine.plant import PlantSettings
from tests.stages.machine_stage import MachineStage

TURNS = 100


def test_a_bus_that_is_not_open_yet_has_none() -> None:
    """Failed before: NodeLost, as a traceback in the log, when somebody looked during a start."""
    stage = MachineStage(Path("config/corexy_toolhead.cfg"), plant=PlantSettings())

    async def main() -> None:
        machine = Machine(stage.description, stage.host, build_modules(stage.description))
        starting, seen = asyncio.ensure_future(machine.start()), set()
        for _ in range(TURNS):
            seen.add(len(machine.bus_stats()))
            assert not machine.is_busy(0.5)
            machine.check_load()
            await asyncio.sleep(0)
        await starting
        assert len(machine.bus_stats()) == 1
        assert 0 in seen
        await machine.close()

    stage.run(main)

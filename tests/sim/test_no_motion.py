"""kinematics none: a machine of heaters and fans alone runs, and moves of the head are refused."""

import asyncio
from pathlib import Path

import pytest

from coordinator.virtual_machine.plant_heat import HeatSettings
from nodes.support.errors import CanductorError
from tests.stages.plant_stage import PlantStage
from tests.stages.served import running


def test_it_heats_and_a_job_is_done(tmp_path: Path) -> None:
    stage = PlantStage(tmp_path, Path("config/none.cfg"), None, heat=HeatSettings(hurry=30.0))

    async def go() -> None:
        async with running(stage.served):
            call = stage.served.call
            await call("gcode.run", script="G28\nSET_HEATER_TEMPERATURE HEATER=dryer TARGET=50")
            await call(
                "gcode.run", script="TEMPERATURE_WAIT SENSOR=dryer MINIMUM=45\nSET_FAN_SPEED FAN=air SPEED=1"
            )
            with pytest.raises(CanductorError, match="X 10 mm, outside 0 to 0 mm"):
                await call("gcode.run", script="G1 X10 F600")
            stage.served.write_job("G28\nG4 P500\nM105\n")
            await call("job.start", file="job.gcode")
            await stage.served.until_job("done")

    with asyncio.Runner(loop_factory=stage.stage.make_loop) as runner:
        runner.run(go())

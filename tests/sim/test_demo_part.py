"""What the demo plays, in virtual time: its own machine prints its own part, and keeps its heaters steady."""

import asyncio
from pathlib import Path

from coordinator.heat.controller import NEAR_K
from coordinator.verification.heat_proof import HeatWatch
from coordinator.virtual_machine.plant_heat import HeatSettings
from tests.stages.plant_stage import PlantStage
from tests.stages.served import running

DEMO = Path(__file__).parents[2] / "config" / "demo"


def test_its_heaters_hold_their_targets_though_the_fan_comes_on(tmp_path: Path) -> None:
    """At the second layer the part's fan goes to full speed and the hotend's target down, at once."""
    warm = HeatSettings(warm_c={"extruder": 195.0, "heater_bed": 55.0})
    stage = PlantStage(tmp_path, DEMO / "machine.cfg", None, heat=warm)
    watch = HeatWatch()

    async def go() -> None:
        async with running(stage.served):
            assert stage.served.service.machine is not None
            watch.attach(stage.served.service.machine)
            stage.served.write_job((DEMO / "part.gcode").read_text(encoding="utf-8"))
            await stage.served.call("job.start", file="job.gcode")
            await stage.served.until_job("done", limit_s=600)
            await stage.check_all()

    with asyncio.Runner(loop_factory=stage.stage.make_loop) as runner:
        runner.run(go())
    kept = [(state.heater, state.held.target_c, state.held.deviation_k) for state in watch.states]
    assert {(heater, target_c) for heater, target_c, _ in kept} == {
        ("extruder", 210.0),
        ("extruder", 205.0),
        ("heater_bed", 60.0),
    }
    assert all(deviation_k <= NEAR_K for _, _, deviation_k in kept), kept

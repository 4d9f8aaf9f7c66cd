"""Configurations of other people's machines, unchanged: they heat, home and print, in virtual time."""

import asyncio
from pathlib import Path

import pytest

from coordinator.virtual_machine.plant_heat import HeatSettings
from tests.stages.plant_stage import PlantStage
from tests.stages.served import running

SHARED = Path(__file__).parents[2] / ".." / "shared" / "data" / "config"
HOTEND_C, BED_C = 200, 50
WARM_C = {"extruder": 195.0, "heater_bed": 48.0}


@pytest.mark.parametrize("name", ["cartesian_plain", "corexy_is_pa", "corexy_is_pa_toolhead"])
def test_a_machine_runs_unchanged(tmp_path: Path, name: str) -> None:
    path = SHARED / f"{name}.cfg"
    if not path.is_file():
        pytest.skip(f"there is no {path}")
    stage = PlantStage(tmp_path, path, None, heat=HeatSettings(warm_c=WARM_C))

    def true_c(body: str) -> float:
        pages = {node.name: stage.plants[node.name].page for node in stage.description.nodes}
        pin = "toolhead" if body == "extruder" and "toolhead" in pages else "mcu"
        return pages[pin].temperature(body)

    async def go() -> None:
        async with running(stage.served):
            await stage.served.call("gcode.run", script=f"M140 S{BED_C}\nM104 S{HOTEND_C}\nG28")
            await stage.check_all()
            async with asyncio.timeout(300):
                await stage.served.call("gcode.run", script=f"M190 S{BED_C}\nM109 S{HOTEND_C}\nG4 P5000")
            assert true_c("extruder") == pytest.approx(HOTEND_C, abs=5)
            assert true_c("heater_bed") == pytest.approx(BED_C, abs=5)
            text = f"G1 Z5 F600\nM109 S{HOTEND_C + 5}\nG1 X90 Y90 E4 F6000\nG1 X60 E8\nG1 Y60 E12\n"
            stage.served.write_job(text)
            await stage.served.call("job.start", file="job.gcode")
            heats = text.index("M109")
            await stage.served.until(lambda: stage.served.tree.get("job.done_bytes") == heats, "M109 waits")
            await stage.served.until_job("done")
            await stage.check_all()
            told = await stage.served.call("position.get", ask_nodes=True)
            assert told["rails"]["extruder"] == pytest.approx(12, abs=0.01)
            node = next(s.node for s in stage.description.steppers if s.name == "extruder")
            turned = stage.plants[node].page.motors["extruder"]  # only while its driver is on
            assert abs(turned.count) == told["nodes_steps"]["extruder"]
            assert turned.lost == 0
            assert told["nodes_steps"] == {n: s["steps_sent"] for n, s in told["steppers"].items()}

    with asyncio.Runner(loop_factory=stage.stage.make_loop) as runner:
        runner.run(go())

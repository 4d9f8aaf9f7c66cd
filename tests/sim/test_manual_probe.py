"""Heights found by hand, on a simulated machine."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from coordinator.ipc.protocol.methods import ApiError
from tests.stages.plant_stage import PlantStage
from tests.stages.safety_rig import MACHINE
from tests.stages.served import running


def test_a_height_is_found_and_the_endstop_corrected(tmp_path: Path) -> None:
    path = tmp_path / "probe.cfg"
    z = "rotation_distance: 8\nposition_endstop: 0"
    path.write_text(MACHINE.read_text().replace(z, f"{z}.5\nposition_min: -1"))
    stage = PlantStage(tmp_path, path)

    async def run(script: str) -> list[str]:
        told = await stage.served.call("gcode.run", script=script)
        return list(told["replies"])

    async def go() -> None:
        async with running(stage.served):
            await check_refusals(run)
            await run("G28\nG1 Z2 F600")
            assert (await run("Z_ENDSTOP_CALIBRATE SPEED=8"))[-1] == "Z position: ? --> 2.000 <-- ?"
            assert await run("TESTZ Z=-1.6") == ["Z position: ? --> 0.400 <-- 2.000"]
            assert await run("TESTZ Z=-") == ["Z position: ? --> 0.150 <-- 0.400"]
            assert await run("TESTZ Z=+") == ["Z position: 0.150 --> 0.275 <-- 0.400"]
            assert await run("TESTZ Z=--") == ["Z position: ? --> 0.150 <-- 0.275"]
            assert stage.served.planned[2] == pytest.approx(0.15)
            assert stage.served.service.machine is not None
            unsaved = stage.served.service.machine.unsaved
            assert not unsaved.pending
            (told,) = await run("ACCEPT")
            assert told == "stepper_z: position_endstop: 0.350; SAVE_CONFIG writes it and restarts"
            assert unsaved.pending == {"stepper_z": {"position_endstop": "0.350"}}
            await run("SET_GCODE_OFFSET Z=-0.1")
            (told,) = await run("Z_OFFSET_APPLY_ENDSTOP")
            assert told.startswith("stepper_z: position_endstop: 0.600;")
            await run("MANUAL_PROBE")
            assert await run("ABORT") == ["nothing is kept; Z stays at 0.150"]
            with pytest.raises(ApiError, match="ACCEPT is for looking for a height; begin with"):
                await run("ACCEPT")

    with asyncio.Runner(loop_factory=stage.stage.make_loop) as runner:
        runner.run(go())


@pytest.mark.parametrize(
    ("script", "outside"),
    [
        ("SET_GCODE_OFFSET Z=1.6\nZ_OFFSET_APPLY_ENDSTOP", "-1.100"),
        ("G1 Z2 F600\nZ_ENDSTOP_CALIBRATE\nACCEPT", "-1.500"),
        ("SET_GCODE_OFFSET Z=-250\nZ_OFFSET_APPLY_ENDSTOP", "250.500"),
    ],
)
def test_an_endstop_outside_the_axis_is_not_kept(tmp_path: Path, script: str, outside: str) -> None:
    """It was saved, and no start accepted it any more."""
    path = tmp_path / "probe.cfg"
    z = "rotation_distance: 8\nposition_endstop: 0"
    path.write_text(MACHINE.read_text().replace(z, f"{z}.5\nposition_min: -1"))
    stage = PlantStage(tmp_path, path)

    async def go() -> None:
        async with running(stage.served):
            await stage.served.call("gcode.run", script="G28")
            way_out = "raise position_max" if outside == "250.500" else "lower position_min"
            with pytest.raises(ApiError, match=rf"would be {outside}, .*\(-1 to 250 mm\).*; {way_out}"):
                await stage.served.call("gcode.run", script=script)
            assert stage.served.service.machine is not None
            assert not stage.served.service.machine.unsaved.pending

    with asyncio.Runner(loop_factory=stage.stage.make_loop) as runner:
        runner.run(go())


async def check_refusals(run: Callable[[str], Awaitable[list[str]]]) -> None:
    for script, sentence in (
        ("MANUAL_PROBE", "comes before Z is homed"),
        ("TESTZ Z=1", "TESTZ is for looking for a height"),
        ("G28\nMANUAL_PROBE SPEED=900", "at most 20 mm/s"),
        ("MANUAL_PROBE\nMANUAL_PROBE", "is looked for already"),
        ("TESTZ", "TESTZ has no Z"),
        ("TESTZ Z=++", "none was tried above"),
        ("TESTZ Z=-90", "outside -1 to 250 mm"),
        ("ABORT\nTESTZ Z=1", "TESTZ is for looking for a height"),
    ):
        with pytest.raises(ApiError) as error:
            await run(script)
        assert sentence in str(error.value), script

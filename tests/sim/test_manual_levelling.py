"""Beds that are measured by hand, on a simulated machine without a probe."""

import asyncio
import json
from pathlib import Path

import pytest

from coordinator.ipc.protocol.methods import ApiError
from tests.stages.plant_stage import PlantStage
from tests.stages.printer_text import section
from tests.stages.safety_rig import MACHINE
from tests.stages.served import Served, running

SECTIONS = section(
    "bed_mesh", mesh_min="20, 30", mesh_max="120, 130", probe_count="3, 3", horizontal_move_z=4
) + section("screws_tilt_adjust", screw1="20, 20", screw2="120, 20", screw3="70, 120", horizontal_move_z=3)
XS, YS = (20.0, 70.0, 120.0), (30.0, 80.0, 130.0)


def shape(x: float, y: float) -> float:
    return round(0.1 + 0.002 * x - 0.001 * y + 0.00001 * x * y, 3)


async def run(served: Served, script: str) -> list[str]:
    return list((await served.call("gcode.run", script=script))["replies"])


async def accept_at(served: Served, z: float) -> list[str]:
    """Bring the nozzle to Z and take it."""
    return await run(served, f"TESTZ Z={z - served.planned[2]:.6f}\nACCEPT")


def test_a_bed_is_measured_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "manual.cfg"
    z = "rotation_distance: 8\nposition_endstop: 0"
    path.write_text(MACHINE.read_text().replace(z, f"{z}\nposition_min: -2") + SECTIONS)
    stage = PlantStage(tmp_path, path)

    async def go() -> None:
        async with running(stage.served):
            await check_mesh(stage.served)
            await check_screws(stage.served)

    with asyncio.Runner(loop_factory=stage.stage.make_loop) as runner:
        runner.run(go())


async def check_mesh(served: Served) -> None:
    with pytest.raises(ApiError, match="before Z is homed"):
        await run(served, "BED_MESH_CALIBRATE")
    with pytest.raises(ApiError, match="is automatic, and there is no probe; give METHOD=manual"):
        await run(served, "G28\nBED_MESH_CALIBRATE METHOD=automatic")
    with pytest.raises(ApiError, match="automatic and manual are possible"):
        await run(served, "BED_MESH_CALIBRATE METHOD=thumb")
    begun = await run(served, "G1 Z10 F900\nBED_MESH_CALIBRATE")
    assert begun[0] == "place 1 of 9: 20.000,30.000"
    assert begun[-1] == "Z position: ? --> 4.000 <-- ?"
    with pytest.raises(ApiError, match="is looked for already"):
        await run(served, "BED_MESH_CALIBRATE")
    for y, row in zip(YS, (XS, XS[::-1], XS), strict=True):
        for x in row:
            assert served.planned[:3] == pytest.approx((x, y, 4.0))
            told = await accept_at(served, shape(x, y))
    assert told[-1].endswith("it is profile default, which SAVE_CONFIG writes")
    (mapped,) = await run(served, "BED_MESH_MAP")
    heights = json.loads(mapped.removeprefix("mesh_map_output"))["z_positions"]
    assert heights == [[pytest.approx(shape(x, y)) for x in XS] for y in YS]
    assert await run(served, "BED_MESH_CALIBRATE METHOD=MANUAL\nABORT")
    with pytest.raises(ApiError, match="ACCEPT is for looking for a height"):
        await run(served, "ACCEPT")
    await run(served, "BED_MESH_CLEAR")


async def check_screws(served: Served) -> None:
    await run(served, "SCREWS_TILT_CALCULATE")
    await accept_at(served, 0.0)
    await accept_at(served, 0.25)
    told = await accept_at(served, -0.5)
    assert [line.rpartition(" : ")[2] for line in told[-2:]] == ["adjust CCW 00:30", "adjust CW 01:00"]

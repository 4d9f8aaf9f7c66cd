"""What does not act is never guessed: not where an axis is, not that something is hot or level."""

from pathlib import Path

import pytest

from nodes.support.errors import CanductorError
from tests.stages.printer import PRINTING, Printer, gcode
from tests.stages.served import Served

NOT_ACTING = """
[stepper_z]
endstop_pin: probe:z_virtual_endstop
[dockable_probe]
pin: PA9
z_offset: 1
[bed_mesh]
mesh_min: 10, 10
mesh_max: 90, 90
[neopixel light]
pin: PA10
[extruder]
sensor_type: MAX31865
"""
SAFE = "[safe_z_home]\nhome_xy_position: -10, -10\nz_hop: 5\n"


async def refusal(stage: Served, line: str) -> str:
    with pytest.raises(CanductorError) as error:
        await gcode(stage, line)
    return str(error.value)


def test_it_is_refused_or_skipped_with_a_notice(tmp_path: Path) -> None:
    printer = Printer(tmp_path, PRINTING + NOT_ACTING)
    before = [printer.true_mm(axis) for axis in "xy"]

    async def go(stage: Served) -> None:
        assert "G28 of Z is refused: the endstop probe:z_virtual_endstop" in await refusal(stage, "G28")
        assert [printer.true_mm(axis) for axis in "xy"] == before, "nothing moved"
        await gcode(stage, "G28 X Y")
        assert "homed" in await refusal(stage, "G1 Z5 F600")
        heats = await refusal(stage, "M109 S200")
        assert "M109 heats, but [extruder] is not supported yet: its sensor is a MAX31865" in heats
        await gcode(stage, "M104 S0")
        assert "cold" in await refusal(stage, "G1 E5 F300")
        assert "[bed_mesh] is not supported yet" in await refusal(stage, "BED_MESH_CALIBRATE")
        assert "[bed_mesh] is not supported yet" in await refusal(stage, "G29")
        await gcode(stage, "QUAD_GANTRY_LEVEL", "SET_LED LED=light RED=1", "BED_MESH_CLEAR", "WHAT_IS_THIS")
        stage.write_job("G28 X Y\nBED_MESH_PROFILE LOAD=default\nG1 X20 F6000\n")
        await stage.call("job.start", file="job.gcode")
        await stage.until_job("failed")
        job = await stage.call("job.status")
        assert "BED_MESH_PROFILE measures or corrects where the bed is" in str(job)

    printer.serve(go)


def test_a_place_for_z_outside_of_the_axes_is_refused_before_anything_moves(tmp_path: Path) -> None:
    printer = Printer(tmp_path, PRINTING + SAFE)
    before = [printer.true_mm(axis) for axis in "xy"]

    async def go(stage: Served) -> None:
        said = await refusal(stage, "G28")
        assert "G28 of Z is refused: home_xy_position of [safe_z_home] is -10, -10, but X goes from" in said
        assert [printer.true_mm(axis) for axis in "xy"] == before, "nothing moved"

    printer.serve(go)

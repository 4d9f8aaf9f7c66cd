"""Skew on a printer: where its steppers truly bring the head, through homing and other corrections."""

from pathlib import Path

import pytest

from coordinator.modules.compensation.skew_correction import Skew
from tests.stages.printer import PRINTING, Printer, gcode
from tests.stages.served import Served

SKEW = Skew(xy=0.01, xz=-0.002, yz=0.003)
SECTIONS = PRINTING + "[skew_correction cold]\nxy_skew: 0.01\nxz_skew: -0.002\nyz_skew: 0.003\n"


def test_the_head_is_where_leaning_axes_have_to_bring_it(tmp_path: Path) -> None:
    printer = Printer(tmp_path, SECTIONS)

    def check(x: float, y: float, z: float) -> None:
        believed = SKEW.wanted((x, y, z, 0.0))[:3]
        assert [printer.true_mm(axis) for axis in "xyz"] == pytest.approx(believed, abs=0.01)

    async def go(stage: Served) -> None:
        await gcode(stage, "G28", "G90", "G1 X100 Y180 Z20 F9000")
        before = [printer.true_mm(axis) for axis in "xyz"]
        await gcode(stage, "SKEW_PROFILE LOAD=cold")
        assert [printer.true_mm(axis) for axis in "xyz"] == before
        await gcode(stage, "G1 X100 Y180 Z20 F9000")
        check(100, 180, 20)
        await gcode(stage, "G1 X30 Y40 Z5")
        check(30, 40, 5)
        await gcode(stage, "G28 X", "G1 X60 Y90 F9000")
        check(60, 90, 5)
        await gcode(stage, "G28", "G1 X200 Y30 Z10 F9000")
        check(200, 30, 10)
        assert printer.status("skew_correction")["current_profile_name"] == "cold"
        await gcode(stage, "SKEW_PROFILE SAVE=warm")
        pending = printer.status("configfile")["save_config_pending_items"]
        assert pending == {
            "skew_correction warm": {"xy_skew": "0.010000", "xz_skew": "-0.002000", "yz_skew": "0.003000"}
        }

    printer.serve(go)

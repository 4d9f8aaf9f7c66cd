"""Macros that nearly every user includes, played in virtual time: mainsail.cfg, KAMP, klipper-macros."""

from pathlib import Path

import pytest

from coordinator.assembly.check import check_config
from tests.stages.printer import PRINTING, Printer, gcode
from tests.stages.served import Served

MACROS = Path(__file__).parents[2] / ".." / "shared" / "data" / "config" / "real" / "macros"
VARIABLES = """
[gcode_macro _CLIENT_VARIABLE]
variable_use_custom_pos: True
variable_custom_park_x: 15.0
variable_custom_park_y: 20.0
variable_custom_park_dz: 3.0
variable_retract: 1.0
variable_park_at_cancel: True
variable_runout_sensor: ""
variable_user_pause_macro: ""
gcode:
"""
PLACES = """
[firmware_retraction]
retract_length: 0.5
[bed_mesh]
mesh_min: 10, 10
mesh_max: 200, 200
probe_count: 5, 5
[save_variables]
filename: variables.cfg
"""


def macros(name: str) -> str:
    """Return what includes a file of macros."""
    path = MACROS / name
    if not path.parent.is_dir():
        pytest.skip(f"there is no {path}")
    return f"[include {path.resolve()}]\n"


@pytest.mark.parametrize(
    "names",
    [
        ("mainsail.cfg",),
        ("fluidd.cfg",),
        *((f"kamp/{name}.cfg",) for name in ("Smart_Park", "Line_Purge", "Voron_Purge", "Adaptive_Meshing")),
        ("kamp/*.cfg",),
        ("klipper-macros/*.cfg",),
        ("klipper-macros/*.cfg", "klipper-macros/optional/*.cfg"),
    ],
    ids=" ".join,
)
def test_they_load(tmp_path: Path, names: tuple[str, ...]) -> None:
    text = Path("config/corexy_toolhead.cfg").read_text(encoding="utf-8")
    path = tmp_path / "printer.cfg"
    path.write_text(text + PRINTING + PLACES + "".join(map(macros, names)), encoding="utf-8")
    assert check_config(str(path)) == []


def test_pause_resume_and_cancel_of_a_front_end(tmp_path: Path) -> None:
    printer = Printer(tmp_path, macros("mainsail.cfg") + VARIABLES)

    async def go(stage: Served) -> None:
        await gcode(stage, "G28", "M109 S200")
        stage.write_job("G90\nM83\nG1 X60 Y60 Z2 F6000\n" + "G1 X90 E1 F1200\nG1 X60 E1\n" * 40)
        await stage.call("job.start", file="job.gcode")
        await stage.until_job("printing")
        await gcode(stage, "PAUSE")
        await stage.until_job("paused")
        await gcode(stage, "M400")
        assert printer.true_mm("x") == pytest.approx(15, abs=0.1)
        assert printer.true_mm("y") == pytest.approx(20, abs=0.1)
        await gcode(stage, "RESUME")
        await stage.until_job("printing")
        await gcode(stage, "CANCEL_PRINT")
        await stage.until_job("cancelled")
        await gcode(stage, "M400")
        assert printer.true_mm("y") == pytest.approx(20, abs=0.1)
        assert printer.true_mm("x") == pytest.approx(15, abs=0.1)

    printer.serve(go)


KAMP = ("kamp/KAMP_Settings.cfg", "kamp/Smart_Park.cfg", "kamp/Line_Purge.cfg")
OBJECT = "EXCLUDE_OBJECT_DEFINE NAME=a CENTER=100,100 POLYGON=[[80,80],[120,80],[120,120],[80,120]]"


def test_parking_and_purging_beside_what_is_printed(tmp_path: Path) -> None:
    printer = Printer(tmp_path, PRINTING + PLACES + "".join(map(macros, KAMP)))

    async def go(stage: Served) -> None:
        await gcode(stage, "G28", "M109 S200")
        stage.write_job(f"{OBJECT}\nSMART_PARK\nM400\nLINE_PURGE\nG1 X100 Y100 F6000\n")
        await stage.call("job.start", file="job.gcode")
        await stage.until_job("done")
        assert printer.true_mm("x") == pytest.approx(100, abs=0.1)
        told = await stage.call("position.get", ask_nodes=True)
        assert told["rails"]["extruder"] > 20, "filament was purged"

    printer.serve(go)

"""Files as slicers write them for such machines: all of them are planned, and printed in virtual time."""

from pathlib import Path

import pytest

from coordinator.planning.options import PlanOptions
from coordinator.planning.plan import plan_file
from tests.stages.printer import PRINTING, Printer
from tests.stages.served import Served

SLICERS = Path(__file__).parents[2] / ".." / "shared" / "data" / "config" / "real" / "slicers"
NAMES = ("cura", "orca", "prusa", "super")
MACHINE = """
[firmware_retraction]
retract_length: 0.5
[stepper_z]
position_min: -1
[fan_generic fg]
pin: PF1
[output_pin o]
pin: PF2
[filament_switch_sensor fil]
switch_pin: PF3
pause_on_runout: False
[delayed_gcode dg]
gcode:
[skew_correction]
[skew_correction my]
xy_skew: 0.001
[gcode_macro START_PRINT]
gcode:
    G28
    M140 S{params.BED_TEMP|default(60)|float}
    M109 S{params.EXTRUDER_TEMP|default(200)|float}
[gcode_macro END_PRINT]
gcode:
    TURN_OFF_HEATERS
    M84
"""


def sliced(name: str) -> str:
    path = SLICERS / f"{name}.gcode"
    if not path.is_file():
        pytest.skip(f"there is no {path}")
    return path.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", NAMES)
def test_it_is_planned_and_printed(tmp_path: Path, name: str) -> None:
    text = sliced(name)
    printer = Printer(tmp_path, PRINTING + MACHINE)
    report = plan_file(PlanOptions(config=printer.config, gcode=SLICERS / f"{name}.gcode"))
    assert report.ok

    async def go(stage: Served) -> None:
        stage.write_job(text)
        await stage.call("job.start", file="job.gcode")
        await stage.until_job("done")
        told = await stage.call("position.get", ask_nodes=True)
        assert told["nodes_steps"] == {n: s["steps_sent"] for n, s in told["steppers"].items()}

    printer.serve(go)

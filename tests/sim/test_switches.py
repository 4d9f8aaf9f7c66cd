"""Buttons and filament sensors of a printer, on its nodes' pins: what they do with a job, and without one."""

from pathlib import Path

import pytest

from tests.stages.printer import PRINTING, Printer, gcode
from tests.stages.served import Served

SECTIONS = (
    PRINTING
    + """
[gcode_macro PAUSE]
rename_existing: PAUSE_BASE
gcode:
    PAUSE_BASE
    G91
    G1 Z5 F900
    G90
    G1 X10 Y10 F9000
[gcode_macro M600]
gcode:
    PAUSE
    RESPOND MSG="change the filament"
[gcode_macro MAYBE]
gcode:
    {% if params.NOW|default(0)|int %}
    PAUSE
    {% endif %}
[filament_switch_sensor runout]
switch_pin: ^toolhead:PC4
event_delay: 1
runout_gcode:
    RESPOND MSG="{printer["filament_switch_sensor runout"].filament_detected}"
insert_gcode:
    M600
[filament_switch_sensor second]
switch_pin: !PC6
pause_on_runout: False
event_delay: 0
runout_gcode:
    G91
    G1 Z3 F900
[gcode_button door]
pin: ^!PC7
press_gcode:
    M600
release_gcode:
    M117 shut
"""
)
JOB = "G28\nG90\nG1 Z1 F900\nG1 X20 Y20 F9000\n" + "".join(
    f"G1 X{20 + n % 2 * 60} Y{20 + n % 3 * 10} F6000\n" for n in range(40)
)
PINS = {"runout": ("toolhead", "PC4", 1), "second": ("mcu", "PC6", 0), "door": ("mcu", "PC7", 0)}
"""Node, pin, and the level that stands for filament, or for pressed."""


def put(printer: Printer, name: str, *, there: bool) -> None:
    node, pin, level = PINS[name]
    printer.node(node).set_input(printer.stage.pins(node)[pin], level if there else 1 - level)


def told(stage: Served, text: str) -> int:
    return sum(text in line for line in stage.lines)


async def printing(stage: Served) -> None:
    await stage.call("job.start", file="job.gcode")
    await stage.until(lambda: int(str(stage.tree.get("job.line") or 0)) > 5, "a line being carried out")


def filament(printer: Printer, name: str) -> bool:
    return printer.status(f"filament_switch_sensor {name}")["filament_detected"] is True


def begin(folder: Path) -> Printer:
    printer = Printer(folder, SECTIONS)
    for name in PINS:
        put(printer, name, there=name != "door")
    return printer


def test_a_job_that_runs_out_of_filament_pauses_and_parks(tmp_path: Path) -> None:
    printer = begin(tmp_path)

    async def go(stage: Served) -> None:
        stage.write_job(JOB)
        await stage.until(lambda: filament(printer, "runout") and filament(printer, "second"), "filament")
        assert await gcode(stage, "QUERY_FILAMENT_SENSOR SENSOR=runout") == [
            "Filament Sensor runout: filament detected"
        ]
        assert not told(stage, "change"), "what there is from the start is not put in"
        await printing(stage)
        put(printer, "runout", there=False)
        await stage.until_job("paused")
        await stage.until(lambda: told(stage, "echo: False") == 1, "runout_gcode")
        assert told(stage, "filament_switch_sensor runout: the filament has run out")
        assert stage.planned[:3] == pytest.approx((10, 10, 6))
        put(printer, "runout", there=True)
        await stage.until(lambda: filament(printer, "runout"), "filament")
        await gcode(stage, "SET_FILAMENT_SENSOR SENSOR=runout ENABLE=0", "RESUME")
        put(printer, "runout", there=False)
        await stage.until(lambda: not filament(printer, "runout"), "no filament")
        await stage.until_job("done")
        assert printer.status("filament_switch_sensor runout")["enabled"] is False

    printer.serve(go)


def test_what_only_acts_lets_the_job_go_on(tmp_path: Path) -> None:
    printer = begin(tmp_path)

    async def go(stage: Served) -> None:
        stage.write_job(JOB)
        await printing(stage)
        put(printer, "second", there=False)
        await stage.until(lambda: printer.true_mm("z") > 3.9, "what runout_gcode does")
        assert stage.job_state in ("pausing", "paused")
        await stage.until_job("printing")
        await gcode(stage, "MAYBE")
        assert stage.job_state == "printing"
        put(printer, "door", there=True)
        await stage.until(lambda: told(stage, "change the filament") == 1, "M600")
        await stage.until_job("paused")
        put(printer, "door", there=False)
        await stage.until(lambda: printer.status("gcode_button door")["state"] == "RELEASED", "the door")
        assert await gcode(stage, "QUERY_BUTTON BUTTON=door") == ["door: RELEASED"]
        await gcode(stage, "RESUME")
        await stage.until_job("printing")
        await gcode(stage, "M600")
        await stage.until_job("paused")
        assert stage.planned[:3] == pytest.approx((10, 10, 6))
        await gcode(stage, "RESUME")
        await stage.until_job("done")
        assert stage.planned[2] == 1

    printer.serve(go)

"""What clients may do while a job prints: all that neither moves nor waits; for the rest, one sentence."""

import re
from pathlib import Path

import pytest

from coordinator.gcode.builtins.basic import WHILE_PRINTING
from coordinator.ipc.protocol.methods import ApiError
from coordinator.modules.module_set import build_modules
from tests.stages.printer import PRINTING, Printer, gcode
from tests.stages.served import Served

SECTIONS = (
    PRINTING
    + """
[fan_generic box]
pin: PB4
[output_pin light]
pin: PB3
value: 0
[temperature_fan chamber]
pin: PB5
sensor_type: Generic 3950
sensor_pin: PB6
min_temp: 0
max_temp: 100
target_temp: 40
control: watermark
[gcode_macro KEEP]
variable_n: 0
gcode:
    SET_GCODE_VARIABLE MACRO=KEEP VARIABLE=n VALUE={params.N}
    SET_FAN_SPEED FAN=box SPEED={params.N|float / 10}
[gcode_macro M221]
rename_existing: M221.1
gcode:
    M221.1 S{params.S|float * 2}
"""
)
JOB = "G28\nG90\nM82\nG92 E0\nG1 Z0.3 F600\n" + "".join(
    f"G1 X{20 + n % 2 * 100} Y{20 + n % 3 * 10} F6000\n" for n in range(25)
)


def test_commands_that_neither_move_nor_wait(tmp_path: Path) -> None:
    printer = Printer(tmp_path, SECTIONS)

    async def go(stage: Served) -> None:
        stage.write_job(JOB)
        await stage.call("job.start", file="job.gcode")
        await stage.until(lambda: bool(stage.tree.get("job.line")), "a line being carried out")

        async def come(section: str, **wanted: object) -> None:
            await stage.until(
                lambda: wanted.items() <= printer.status(section).items(), f"{wanted} of {section}"
            )

        await gcode(stage, "M104 S150")
        await come("extruder", target=150)
        await gcode(stage, "SET_HEATER_TEMPERATURE HEATER=extruder TARGET=160")
        await come("extruder", target=160)
        await gcode(stage, "M140 S55")
        await come("heater_bed", target=55)
        assert (await gcode(stage, "M105"))[0].startswith("B:")
        await gcode(stage, "TURN_OFF_HEATERS")
        await come("extruder", target=0)
        await come("heater_bed", target=0)
        await gcode(stage, "M106 S51")
        await come("fan", speed=0.2)
        await gcode(stage, "M107")
        await come("fan", speed=0)
        await gcode(stage, "SET_FAN_SPEED FAN=box SPEED=0.5")
        await come("fan_generic box", speed=0.5)
        await gcode(stage, "SET_TEMPERATURE_FAN_TARGET TEMPERATURE_FAN=chamber TARGET=35")
        await come("temperature_fan chamber", target=35)
        await gcode(stage, "SET_PIN PIN=light VALUE=1")
        await come("output_pin light", value=1)
        await gcode(stage, "KEEP N=7")
        await come("gcode_macro KEEP", n=7)
        await come("fan_generic box", speed=0.7)
        await gcode(stage, "M220 S150", "M221 S45")
        await stage.until(lambda: stage.tree.get("position.speed_factor") == 1.5, "the new speed")
        assert stage.tree.get("position.extrude_factor") == 0.9
        await gcode(stage, "SET_PRESSURE_ADVANCE ADVANCE=0.06")
        (told,) = await gcode(stage, "SET_PRESSURE_ADVANCE")
        assert told == "extruder: ADVANCE=0.06 SMOOTH_TIME=0.04"
        await gcode(stage, "SET_GCODE_OFFSET Z_ADJUST=0.05 MOVE=1", "SET_GCODE_OFFSET Z_ADJUST=-0.02 MOVE=1")
        assert stage.job_state == "printing"
        await stage.until_job("done")
        assert stage.planned[2] == pytest.approx(0.33)

    printer.serve(go)


def test_the_page_names_all_of_them(tmp_path: Path) -> None:
    sections = SECTIONS + "[idle_timeout]\n[firmware_retraction]\n[save_variables]\nfilename: kept.cfg\n"
    sections += (
        "[gcode_button door]\npin: PB7\npress_gcode: M117\n[filament_switch_sensor a]\nswitch_pin: PB8\n"
    )
    printer = Printer(tmp_path, sections + "[delayed_gcode tick]\ngcode:\n    M117\n")
    description = printer.load()
    known = build_modules(description).vocabulary.commands
    own = {name for name in known if not name.startswith("_") and not name.startswith(("KEEP", "M221"))}
    beside = {name for name in own if known[name].while_printing} | WHILE_PRINTING
    page = Path("docs/gcode.md").read_text(encoding="utf-8").partition("## Beside a job")[2]
    rows = " ".join(line for line in page.partition("## ")[0].splitlines() if line.startswith("| "))
    named = set(re.findall(r"\b(?:[A-Z]+(?:_[A-Z]+)+|[GM]\d+|PAUSE|RESUME|RESPOND|HELP|STATUS)\b", rows))
    assert named == beside


REFUSED = ("G28", "M84", "SAVE_CONFIG", "PID_CALIBRATE HEATER=extruder TARGET=200")


def test_commands_that_move_or_wait_come_between_two_lines_of_the_job(tmp_path: Path) -> None:
    printer = Printer(
        tmp_path, SECTIONS + "[gcode_macro GO]\ngcode:\n    M117 on my way\n    G1 X111 F6000\n"
    )

    async def go(stage: Served) -> None:
        stage.write_job(JOB)
        await stage.call("job.start", file="job.gcode")
        await stage.until(lambda: bool(stage.tree.get("job.line")), "a line being carried out")
        for line, x in (("G1 X123 F6000", 123), ("GO", 111)):
            (place,) = await gcode(stage, line, "M114")
            assert place.startswith(f"X:{x}.000")
            await stage.until_job("printing")
        await gcode(stage, "G4 P10", "M400", "T0")
        assert await gcode(stage, "NOBODY_KNOWS_THIS") == []
        await stage.until_job("done", limit_s=600)
        told = await stage.call("position.get", ask_nodes=True)
        assert told["nodes_steps"] == {n: s["steps_sent"] for n, s in told["steppers"].items()}

    printer.serve(go)


def test_commands_that_nobody_means_while_a_job_prints_are_refused(tmp_path: Path) -> None:
    printer = Printer(tmp_path, SECTIONS)

    async def go(stage: Served) -> None:
        stage.write_job(JOB)
        await stage.call("job.start", file="job.gcode")
        await stage.until(lambda: bool(stage.tree.get("job.line")), "a line being carried out")
        for line in REFUSED:
            name = line.partition(" ")[0]
            with pytest.raises(ApiError, match=f"{name} cannot run while a job prints; pause it") as error:
                await gcode(stage, line)
            assert error.value.code == "busy"
        with pytest.raises(ApiError, match="SMOOTH_TIME; pause the job first"):
            await gcode(stage, "SET_PRESSURE_ADVANCE SMOOTH_TIME=0.02")
        with pytest.raises(ApiError, match="would take Z to"):
            await gcode(stage, "SET_GCODE_OFFSET Z_ADJUST=-3 MOVE=1")
        assert stage.job_state == "printing"
        await stage.call("job.cancel")
        await stage.until_job("cancelled")

    printer.serve(go)


def test_a_job_that_waits_for_heat_takes_another_target(tmp_path: Path) -> None:
    printer = Printer(tmp_path)

    async def go(stage: Served) -> None:
        stage.write_job("M109 S250\nM190 S100\nG28\nG1 X20 F6000\n")
        await stage.call("job.start", file="job.gcode")
        await stage.until(lambda: printer.status("extruder")["target"] == 250, "the job's target")
        await gcode(stage, "M104 S60")
        await stage.until(lambda: printer.status("heater_bed")["target"] == 100, "the end of M109")
        assert float(str(printer.status("extruder")["temperature"])) < 120
        await gcode(stage, "M140 S0")
        await stage.until_job("done")
        assert printer.status("extruder")["target"] == 60

    printer.serve(go)

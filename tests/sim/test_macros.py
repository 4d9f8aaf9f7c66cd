"""A whole set of macros as owners have them (tests/data/macros.cfg), with a job as slicers write it."""

from pathlib import Path

import pytest

from coordinator.gcode.program import Program
from coordinator.ipc.protocol.methods import ApiError
from coordinator.service.core.machine_service import ServiceState
from coordinator.service.jobs.forward import read_forward
from tests.coordinator.gcode.templates.attacks import ATTACKS
from tests.stages.printer import Printer, gcode
from tests.stages.served import Served

MACROS = Path("tests/data/macros.cfg").read_text(encoding="utf-8")
LAYERS = 4


def part(layer: int) -> list[str]:
    square = ((90, 80), (110, 80), (110, 100), (90, 100), (90, 80))
    moves = [f"G1 X{x} Y{y} E0.8 F4800" for x, y in square[1:]]
    return [
        ";LAYER_CHANGE", f"SET_PRINT_STATS_INFO CURRENT_LAYER={layer}", f"G1 Z{layer * 0.3:.1f} F900",
        "EXCLUDE_OBJECT_START NAME=cube", "G1 X90 Y80 F9000", *moves, "EXCLUDE_OBJECT_END NAME=cube",
        *(["M600"] if layer == 2 else []), *(["M106 S255"] if layer == 1 else []),
    ]  # fmt: skip


JOB = [
    "EXCLUDE_OBJECT_DEFINE NAME=cube CENTER=100,90 POLYGON=[[90,80],[110,80],[110,100],[90,100]]",
    "PRINT_START BED_TEMP=60 EXTRUDER_TEMP=210 SOAK=1",
    "M900 K0.05", "M83", f"SET_PRINT_STATS_INFO TOTAL_LAYER={LAYERS}",
    *(line for layer in range(1, LAYERS + 1) for line in part(layer)), "PRINT_END",
]  # fmt: skip


def test_they_are_read_again_where_nothing_is_connected(tmp_path: Path) -> None:
    """As a job does that goes on after a crash, and a program that is only planned."""
    description = Printer(tmp_path, MACROS).load()
    tower = (
        "TUNING_TOWER COMMAND=SET_PRESSURE_ADVANCE PARAMETER=ADVANCE START=0.05 STEP_DELTA=0 STEP_HEIGHT=1"
    )
    set_up = ("M203 X80", "M204 T900", "SET_EXTRUDER_ROTATION_DISTANCE EXTRUDER=extruder DISTANCE=20", tower)
    lines = [*set_up, *JOB]
    before = lines.index("PRINT_END")
    job = tmp_path / "job.gcode"
    job.write_text("\n".join(lines) + "\n", encoding="utf-8")
    end_bytes = len("".join(f"{line}\n" for line in lines[:before]))
    with Program.open(job) as program:
        reached = read_forward(description, program, end_bytes)
    assert reached.state.position[:3] == pytest.approx((90, 80, 1.2))
    assert reached.part_mm == pytest.approx(1.2)
    assert reached.variables["gcode_macro _STATE"]["changes"] == 1
    assert "SET_PRESSURE_ADVANCE EXTRUDER=extruder ADVANCE=0.05 SMOOTH_TIME=0.04" in reached.lines
    assert set_up[2:] == (reached.lines[1], reached.lines[0])
    assert (reached.dynamics["travel_accel"], reached.dynamics["axis_limits"]["max_x_velocity"]) == (900, 80)


def told(stage: Served, text: str) -> bool:
    return any(text in line for line in stage.lines)


def test_a_print_with_all_of_them(tmp_path: Path) -> None:
    printer = Printer(tmp_path, MACROS)

    async def go(stage: Served) -> None:
        stage.write_job("\n".join(JOB) + "\n")
        await gcode(stage, "PAUSE_AT_LAYER LAYER=4", "SDCARD_PRINT_FILE FILENAME=job.gcode")
        await stage.until_job("paused")  # by M600 behind layer 2
        assert printer.status("gcode_macro _STATE")["changes"] == 1
        assert told(stage, "4 corners, 134.4 mm away")
        assert told(stage, "// purging at X85.0 Y72.0")
        assert told(stage, "action:prompt_begin Change the filament")
        assert stage.planned[:3] == pytest.approx((60, 10, 10.6))
        assert printer.status("print_stats")["info"] == {"total_layer": 4, "current_layer": 2}
        assert printer.true_c("extruder") > 180
        await gcode(stage, "M104 S150", "LOAD_FILAMENT LENGTH=50 TEMP=180")
        await gcode(stage, "DUMP_STATE")
        await gcode(stage, "RESUME")
        assert printer.status("extruder")["target"] == 210
        await stage.until_job("paused")  # by the wish, before layer 4
        assert told(stage, "// layer 4: pause")
        assert stage.planned[:3] == pytest.approx((10, 20, 10.9))
        await gcode(stage, "PAUSE_AT_LAYER LAYER=0", "RESUME")
        await stage.until_job("done")
        assert stage.planned[:3] == pytest.approx((125, 240, 21.2))
        assert printer.true_mm("z") == pytest.approx(21.2, abs=0.02)
        for heater in ("extruder", "heater_bed"):
            assert printer.status(heater)["target"] == 0
        assert printer.status("fan")["speed"] == 0
        assert printer.status("gcode_macro _STATE")["printing"] is False
        await stage.until(lambda: told(stage, "prints so far: 1"), "what comes after")

        await gcode(stage, "CG28")
        assert told(stage, "all axes are homed")
        stage.write_job("\n".join([*JOB[:2], *["G1 X50 F3000", "G1 X150"] * 9, *JOB[2:]]) + "\n")
        await stage.call("job.start", file="job.gcode")
        await stage.until(lambda: printer.status("gcode_macro _STATE")["printing"] is True, "its begin")
        await stage.until(lambda: sum("purging" in line for line in stage.lines) == 2, "its purge line")
        await gcode(stage, "CANCEL_PRINT")
        await stage.until_job("cancelled")
        assert printer.status("extruder")["target"] == 0
        assert stage.planned[:2] == pytest.approx((125, 230))

        with pytest.raises(ApiError, match="client:1: EXTRUDER_TEMP=295 is too close to the limit of 300"):
            await gcode(stage, "PRINT_START EXTRUDER_TEMP=295")

    printer.serve(go)


def test_a_macro_that_calculates_for_ever_ends_and_the_printer_goes_on(tmp_path: Path) -> None:
    attack = ATTACKS["nested comparison"]
    printer = Printer(
        tmp_path, f"[gcode_macro HOLD]\ngcode:\n    {attack}\n[gcode_macro FINE]\ngcode:\n    G28\n"
    )

    async def go(stage: Served) -> None:
        await gcode(stage, "M104 S60", "G28")
        with pytest.raises(ApiError, match=r"printer.cfg:\d+: \[gcode_macro HOLD\]: it takes more than"):
            await gcode(stage, "HOLD")
        assert printer.status("extruder")["target"] == 60
        stage.write_job("G1 X50 F6000\nHOLD\nG1 X100\n")
        await stage.call("job.start", file="job.gcode")
        await stage.until_job("failed")
        assert stage.planned[0] == pytest.approx(50)
        await gcode(stage, "FINE")
        assert stage.service.state is ServiceState.READY

    printer.serve(go)

"""What programs do with jobs and by themselves, on a service in virtual time."""

import re
from pathlib import Path

import pytest

from coordinator.ipc.protocol.methods import ApiError
from tests.stages.demo_machine import DemoMachine
from tests.stages.printer import gcode as run
from tests.stages.served import Served, zigzag

SECTIONS = """
[pause_resume]
[respond]
[virtual_sdcard]
path: jobs
[idle_timeout]
timeout: 900
gcode:
    RESPOND MSG="left alone"
[save_variables]
filename: kept.cfg
[delayed_gcode tick]
initial_duration: 0.1
gcode:
    RESPOND MSG="tick {printer.print_stats.state} {printer.toolhead.homed_axes}"
    {% if printer.print_stats.state != "complete" %}
    UPDATE_DELAYED_GCODE ID=tick DURATION=0.2
    {% endif %}
[gcode_macro PAUSE]
rename_existing: BASE_PAUSE
gcode:
    BASE_PAUSE
    G91
    G1 Z2 F900
    G90
    G1 X5 Y5 F9000
[gcode_macro LOOK]
gcode:
    RESPOND MSG="{printer.print_stats.state} {printer.pause_resume.is_paused}"
"""
PAUSING = zigzag(10, 1) + "PAUSE\nG1 X40 Y40 E0.1 F9000\nSAVE_VARIABLE VARIABLE=printed VALUE=1\n"


def test_jobs_and_programs(tmp_path: Path) -> None:
    machine = DemoMachine(tmp_path, sections=SECTIONS)

    async def go(stage: Served) -> None:
        stage.write_job(PAUSING, "pausing.gcode")
        assert "pausing.gcode" in (await run(stage, "M20"))[1]
        await run(stage, "SDCARD_PRINT_FILE FILENAME=pausing.gcode")
        await stage.until_job("paused")
        assert stage.planned[:2] == (5, 5)
        # Others may move while it is paused, and run whatever they want.
        await stage.call("move.by", x=3, z=1, speed_mm_s=50)
        assert await run(stage, "LOOK", "G91", "G1 X2 F6000") == ["echo: paused True"]
        assert stage.planned[:2] == (10, 5)
        assert stage.job_state == "paused"
        assert (await stage.call("machine.state"))["state"] == "paused"
        await stage.call("job.resume")
        await stage.until_job("done")
        assert stage.planned[:3] == (40, 40, 1)
        await stage.check_positions()
        job = stage.service.job
        assert job is not None
        assert job.filament_mm == pytest.approx(stage.planned[3], abs=1e-6)
        assert await run(stage, "LOOK") == ["echo: complete False"]
        await stage.until(lambda: any("tick complete xyz" in line for line in stage.lines), "the last tick")
        assert any("tick printing" in line or "tick paused" in line for line in stage.lines)

        stage.write_job(zigzag(150, 1), "long.gcode")
        await stage.homing_comes()
        await stage.call("job.start", file="long.gcode")
        await stage.until(lambda: bool(stage.tree.get("job.line")), "a line being carried out")
        assert await run(stage, "LOOK") == ["echo: printing False"]
        with pytest.raises(ApiError, match="G28 cannot run while a job prints") as error:
            await run(stage, "G28")
        assert error.value.code == "busy"
        await run(stage, "PAUSE")
        await stage.until_job("paused")
        assert stage.planned[:2] == (5, 5)
        await run(stage, "RESUME")
        await stage.until_job("printing")
        await run(stage, "CANCEL_PRINT")
        await stage.until_job("cancelled")
        await stage.until_state("ready")
        await stage.check_positions()

        await run(stage, "SET_IDLE_TIMEOUT TIMEOUT=0.2")
        await stage.until(lambda: any("left alone" in line for line in stage.lines), "the idle timeout")
        assert await run(stage, "RESPOND MSG=here") == ["echo: here"]

    machine.serve(go)
    assert "printed = 1" in (tmp_path / "kept.cfg").read_text(encoding="utf-8")


MISSING = {
    "none.gcode": "there is no file 'none.gcode' in the job folder",
    "../../etc/passwd": "'../../etc/passwd' is not the name of a job; use the name of a file",
    "linked.gcode": "there is no file 'linked.gcode' in the job folder",
}


def test_a_file_that_is_not_there_cannot_be_printed(tmp_path: Path) -> None:
    machine = DemoMachine(tmp_path, sections=SECTIONS)

    async def go(stage: Served) -> None:
        stage.write_job(PAUSING, "there.gcode")
        (stage.jobs / "linked.gcode").symlink_to(machine.config)
        for name, sentence in MISSING.items():
            for line in (f"SDCARD_PRINT_FILE FILENAME={name}", f"M23 {name}"):
                with pytest.raises(ApiError, match=re.escape(sentence)):
                    await run(stage, line)
        assert stage.service.job is None
        assert await run(stage, "M23 /there.gcode") == ["File selected: there.gcode"]
        (stage.jobs / "there.gcode").unlink()
        with pytest.raises(ApiError, match=r"there is no file 'there\.gcode' in the job folder"):
            await run(stage, "M24")

    machine.serve(go)


def test_an_emergency_of_a_macro_and_a_macro_that_does_not_end(tmp_path: Path) -> None:
    forever = "{% for a in range(9999) %}{% for b in range(9999) %}{% endfor %}{% endfor %}"
    machine = DemoMachine(
        tmp_path,
        sections=f"\n[gcode_macro FOREVER]\ngcode:\n    {forever}\n"
        "[gcode_macro STOP]\ngcode:\n    {action_emergency_stop('too hot')}\n",
    )

    async def go(stage: Served) -> None:
        with pytest.raises(ApiError, match="does a loop not end"):
            await run(stage, "FOREVER")
        assert (await stage.call("machine.state"))["state"] == "ready"
        with pytest.raises(ApiError):
            await run(stage, "STOP")
        await stage.until_state("shutdown")

    machine.serve(go)


def test_a_wait_for_less_than_the_room_has_ends(tmp_path: Path) -> None:
    """Failed before: M190 S5 waited for ever."""
    machine = DemoMachine(tmp_path)

    async def go(stage: Served) -> None:
        with pytest.raises(
            ApiError, match=r"\[heater_bed\] stays at 2\d\.\d °C without power, above its target of 5 °C"
        ):
            await run(stage, "M190 S5")
        assert (await stage.call("machine.state"))["state"] == "ready"

    machine.serve(go)

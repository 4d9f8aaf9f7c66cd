"""[idle_timeout] on a printer in virtual time: what is use of the machine, and that nothing stays hot."""

import asyncio
from pathlib import Path

import pytest

from coordinator.gcode.program import Program
from coordinator.service.core.work import FileWork, LinesWork
from coordinator.service.state.log_ring import Entry
from tests.stages.printer import PRINTING, Printer
from tests.stages.printer import gcode as run
from tests.stages.served import Served

POLLING = """
[idle_timeout]
timeout: 20
[delayed_gcode look]
initial_duration: 1
gcode:
    {% if printer.heater_bed.temperature > 900 %}M112{% endif %}
    UPDATE_DELAYED_GCODE ID=look DURATION=0.7
"""
WARM = "M140 S60"
USED = "the machine is used again: [idle_timeout] does nothing"
OFF = "the machine was idle for 20 s: TURN_OFF_HEATERS and M84"


def acting(*lines: str) -> str:
    """Return the section with these LINES, after 20 s."""
    return PRINTING + "[idle_timeout]\ntimeout: 20\ngcode:\n" + "".join(f"    {line}\n" for line in lines)


def bed_c(printer: Printer) -> object:
    return printer.status("heater_bed")["target"]


def state(printer: Printer) -> object:
    return printer.status("idle_timeout")["state"]


def motors_are_on(printer: Printer) -> bool:
    steppers = printer.status("stepper_enable")["steppers"]
    assert isinstance(steppers, dict)
    return any(steppers.values())


async def poll_until_off(printer: Printer, stage: Served, seconds: float) -> set[object]:
    """Ask for the temperatures until the bed is off; return the states that were seen."""
    seen = set()
    async with asyncio.timeout(seconds):
        while bed_c(printer):
            assert (await run(stage, "M105", "M114", "M117 all is well"))[0].startswith("B:")
            seen.add(state(printer))
            await asyncio.sleep(0.3)
    return seen


def test_who_only_asks_does_not_keep_heaters_on(tmp_path: Path) -> None:
    """Failed before: every M105 and every delayed g-code counted as activity."""
    printer = Printer(tmp_path, POLLING)

    async def go(stage: Served) -> None:
        await run(stage, WARM)
        await stage.until(lambda: state(printer) == "Printing", "the target that counts")
        await stage.until(lambda: state(printer) == "Ready", "the machine that waits")
        assert await poll_until_off(printer, stage, 23) == {"Ready", "Idle"}
        assert OFF in stage.lines
        await stage.until(lambda: not motors_are_on(printer), "the motors turned off")

    printer.serve(go)


@pytest.mark.parametrize("line", ["G4 P28000", "TEMPERATURE_WAIT SENSOR=heater_bed MINIMUM=58"])
def test_dwells_and_waits_are_use(tmp_path: Path, line: str) -> None:
    printer = Printer(tmp_path, POLLING, hurry=2.0)

    async def go(stage: Served) -> None:
        began_s = stage.service.now_s
        await run(stage, WARM, line)
        assert stage.service.now_s > began_s + 25
        assert bed_c(printer) == 60
        await stage.until(lambda: not bed_c(printer), "the end of its patience")

    printer.serve(go)


def test_moves_are_use(tmp_path: Path) -> None:
    printer = Printer(tmp_path, POLLING)

    async def go(stage: Served) -> None:
        await run(stage, "G28", WARM)
        for x in range(10):
            await run(stage, f"G1 X{x} F6000")
            await asyncio.sleep(5)
            assert bed_c(printer) == 60
        await stage.until(lambda: not bed_c(printer), "the end of its patience")

    printer.serve(go)


def test_g_code_that_fails_leaves_nothing_on(tmp_path: Path) -> None:
    """Failed before: the error was logged, and that was all."""
    printer = Printer(tmp_path, acting("G1 X5", "TURN_OFF_HEATERS"))

    async def go(stage: Served) -> None:
        await run(stage, "SET_STEPPER_ENABLE STEPPER=stepper_x", WARM)
        await stage.until(lambda: not bed_c(printer), "the bed turned off")
        assert "[idle_timeout]: its g-code failed: TURN_OFF_HEATERS and M84" in stage.lines
        await stage.until(lambda: not motors_are_on(printer), "the motors turned off")
        assert state(printer) == "Idle"

    printer.serve(go)


def test_g_code_that_turns_no_heater_off(tmp_path: Path) -> None:
    printer = Printer(tmp_path, acting("M117 idle"))

    async def go(stage: Served) -> None:
        await run(stage, WARM)
        await stage.until(lambda: not bed_c(printer), "the bed turned off")
        assert (
            "[idle_timeout]: its g-code leaves on heater_bed (60 °C): TURN_OFF_HEATERS and M84" in stage.lines
        )

    printer.serve(go)


def test_what_comes_while_it_acts_is_use(tmp_path: Path) -> None:
    """Failed before: a target set behind its g-code was taken as a part of that, for ever."""
    printer = Printer(tmp_path, acting("TURN_OFF_HEATERS", "G4 P3000"))

    async def go(stage: Served) -> None:
        await run(stage, WARM)
        await stage.until(lambda: not bed_c(printer), "the bed turned off")
        await run(stage, "M140 S50")
        assert bed_c(printer) == 50
        await asyncio.sleep(15)
        assert bed_c(printer) == 50
        await stage.until(lambda: not bed_c(printer), "the bed turned off again")

    printer.serve(go)


def test_a_job_that_is_sent_when_the_machine_has_just_become_idle(tmp_path: Path) -> None:
    """Its g-code waited for the end of what came first, and switched off what that needed."""
    printer = Printer(tmp_path, acting("TURN_OFF_HEATERS", "M84"))

    async def go(stage: Served) -> None:
        def send(entry: Entry) -> None:
            if str(entry["text"]).startswith("the machine was idle"):
                stage.listeners.clear()
                stage.service.ready_motion().feeder.submit(LinesWork(["G1 X10 F6000"]))

        await run(stage, "G28", WARM)
        stage.listeners.append(send)
        await stage.until(lambda: USED in stage.lines, "its g-code, called off")
        assert bed_c(printer) == 60
        assert state(printer) in ("Ready", "Printing")
        await stage.until(lambda: not bed_c(printer), "the end of its patience")

    printer.serve(go)


def test_a_part_keeps_its_bed_warm_while_its_job_is_paused(tmp_path: Path) -> None:
    paused = "{% if printer.pause_resume.is_paused %}M104 S0{% else %}TURN_OFF_HEATERS{% endif %}"
    printer = Printer(tmp_path, acting(paused))

    async def go(stage: Served) -> None:
        stage.write_job(f"{WARM}\nM104 S100\nG28\nG1 X10 F6000\nPAUSE\nG1 X20\n")
        await stage.call("job.start", file="job.gcode")
        await stage.until_job("paused")
        await stage.until(lambda: not printer.status("extruder")["target"], "the extruder turned off")
        await stage.until(lambda: state(printer) == "Idle", "idleness")
        await asyncio.sleep(30)
        assert bed_c(printer) == 60
        kept = "heater_bed (60 °C): left on by the g-code of [idle_timeout], as a job is paused"
        assert stage.lines.count(kept) == 1
        await run(stage, "CANCEL_PRINT")
        await stage.until(lambda: not bed_c(printer), "the bed turned off")

    printer.serve(go)


def test_a_job_that_begins_when_the_machine_has_just_become_idle(tmp_path: Path) -> None:
    printer = Printer(tmp_path, acting("TURN_OFF_HEATERS"))

    async def go(stage: Served) -> None:
        def start(entry: Entry) -> None:
            if str(entry["text"]).startswith("the machine was idle"):
                stage.listeners.clear()
                program = Program.from_lines(["G28\nG1 X100 F600\n"], "job.gcode")
                stage.service.start_job(FileWork(program))

        await run(stage, WARM)
        stage.listeners.append(start)
        await stage.until(lambda: USED in stage.lines, "its g-code, refused")
        await stage.until_job("done")
        assert bed_c(printer) == 60

    printer.serve(go)

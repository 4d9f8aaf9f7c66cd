"""A disk that takes nothing while a machine runs, and sections whose names have blanks; virtual time."""

import threading
from pathlib import Path

from tests.stages.demo_machine import DemoMachine
from tests.stages.served import Served

SECTIONS = """
[save_variables]
filename: no_such_folder/kept.cfg
[delayed_gcode my tick]
initial_duration: 0.1
gcode:
    RESPOND MSG="ticked"
[respond]
"""


def test_variables_that_cannot_be_written_are_reported_on_the_loop(tmp_path: Path) -> None:
    """Failed before: the writer's thread called whoever listens to the log; the blank broke the line."""
    threads: set[threading.Thread] = set()

    async def main(stage: Served) -> None:
        stage.listeners.append(lambda _entry: threads.add(threading.current_thread()))
        await stage.until_state("ready")
        await stage.call("gcode.run", script="SAVE_VARIABLE VARIABLE=a VALUE=1")
        await stage.until(
            lambda: any("cannot be written: no such file" in s for s in stage.lines), "a notice"
        )
        await stage.until(lambda: any("ticked" in line for line in stage.lines), "a tick")
        assert threads == {threading.current_thread()}

    DemoMachine(tmp_path, sections=SECTIONS).serve(main)

"""Files that a machine writes while it runs, disks that take nothing, names with blanks; virtual time."""

import stat
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from coordinator.modules.programs.save_variables import read_variables
from coordinator.service.core.machine_service import WRITE_S
from coordinator.support import file_writer
from coordinator.support.atomic_file import replace_content
from coordinator.support.file_writer import FileWriter
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


KEPT = "[save_variables]\nfilename: kept.cfg\n"


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Keep the disk from answering until this is set."""
    event = threading.Event()

    def write(path: Path, data: bytes) -> None:
        event.wait()
        replace_content(path, data)

    monkeypatch.setattr(file_writer, "replace_content", write)
    yield event
    event.set()


def test_variables_that_a_slow_disk_has_not_yet_are_known_after_a_restart(
    tmp_path: Path, answers: threading.Event
) -> None:
    """Failed before: the control loop waited for the disk."""
    (tmp_path / "kept.cfg").write_text("a = 0\n", encoding="utf-8")

    async def main(stage: Served) -> None:
        for value in (1, 2):
            await stage.call("gcode.run", script=f"SAVE_VARIABLE VARIABLE=a VALUE={value}")
        await stage.call("machine.restart")
        await stage.until(lambda: stage.service.starts == 2, "another start")
        await stage.until_state("ready")
        machine = stage.service.machine
        assert machine is not None
        assert machine.modules.status()["save_variables"] == {"variables": {"a": 2}}
        assert read_variables(tmp_path / "kept.cfg") == {"a": 0}
        await stage.call("gcode.run", script="SAVE_VARIABLE VARIABLE=b VALUE=3")
        answers.set()

    DemoMachine(tmp_path, sections=KEPT).serve(main)
    assert read_variables(tmp_path / "kept.cfg") == {"a": 2, "b": 3}


def test_a_disk_that_does_not_answer_keeps_no_service_from_ending(
    tmp_path: Path, answers: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Failed before: it waited for variables and for the history of jobs."""
    waits: list[float] = []
    lines: list[str] = []

    def wait(files: FileWriter, wait_s: float) -> bool:
        """Do not wait for so long."""
        waits.append(wait_s)
        return real_wait(files, 0.0)

    real_wait = FileWriter.wait
    monkeypatch.setattr(FileWriter, "wait", wait)

    async def main(stage: Served) -> None:
        stage.listeners.append(lambda entry: lines.append(str(entry["text"])))
        await stage.call("gcode.run", script="SAVE_VARIABLE VARIABLE=a VALUE=1")
        await stage.call("job.start", file=stage.write_job("G28\nG1 X5 F6000\n"))
        await stage.until_job("done")

    DemoMachine(tmp_path, sections=KEPT).serve(main)
    assert not answers.is_set()
    assert waits == [WRITE_S]
    assert lines[-1] == "the disk has not answered for 10 s; what was saved last may be lost"


def test_variables_are_written_where_a_link_leads_and_the_mode_stays(tmp_path: Path) -> None:
    """Failed before: the link became a file with mode 0600, and the one it led to kept the old values."""
    real, link = tmp_path / "real.cfg", tmp_path / "link.cfg"
    real.write_text("[Variables]\na = 1\n", encoding="utf-8")
    real.chmod(0o644)
    link.symlink_to("real.cfg")

    async def main(stage: Served) -> None:
        await stage.until_state("ready")
        await stage.call("gcode.run", script="SAVE_VARIABLE VARIABLE=b VALUE=2")

    DemoMachine(tmp_path, sections=f"\n[save_variables]\nfilename: {link}\n").serve(main)
    assert real.read_text(encoding="utf-8") == "[Variables]\na = 1\nb = 2\n"
    assert stat.S_IMODE(real.stat().st_mode) == 0o644
    assert link.is_symlink()

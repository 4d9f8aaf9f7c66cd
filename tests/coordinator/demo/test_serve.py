"""Where a demo that is served has its jobs, and its machine."""

from pathlib import Path

from coordinator.assembly.load import load_machine
from coordinator.demo.serve import to_change, with_jobs
from coordinator.front_ends.serve import ServeOptions
from coordinator.support.examples import DEMO_GCODE, DEMO_MACHINE
from tests.stages.printer_text import DEMO_CFG, write


def test_without_a_folder_the_demos_own_part_is_copied_to_one(tmp_path: Path) -> None:
    found = with_jobs(ServeOptions(name="demo"), load_machine(str(DEMO_MACHINE)), tmp_path)
    assert found.jobs is not None
    assert found.jobs.is_relative_to(tmp_path)
    (part,) = found.jobs.iterdir()
    assert part.read_bytes() == DEMO_GCODE.read_bytes()


def test_a_folder_that_is_named_or_configured_is_taken(tmp_path: Path) -> None:
    named = ServeOptions(name="demo", jobs=tmp_path)
    assert with_jobs(named, load_machine(str(DEMO_MACHINE)), tmp_path) is named
    own = load_machine(write(tmp_path, DEMO_CFG + "\n[virtual_sdcard]\npath: jobs\n"))
    assert with_jobs(ServeOptions(name="demo"), own, tmp_path).jobs is None


def test_an_example_is_copied_for_save_config_and_a_users_file_is_not(tmp_path: Path) -> None:
    copy = to_change(DEMO_MACHINE, tmp_path)
    assert copy.parent == tmp_path
    assert copy.read_bytes() == DEMO_MACHINE.read_bytes()
    own = Path(write(tmp_path, DEMO_CFG))
    assert to_change(own, tmp_path) is own

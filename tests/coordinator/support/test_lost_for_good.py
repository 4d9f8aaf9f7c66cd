"""Lost for good? Power cuts, kills and full or failing disks at each call of every durable write.

A real process writes with the shipped code while a library records its calls, or has one of them fail, or
kills the process there. What a power cut may leave is made from the record (tests/stages/disk_calls.py).
"""

import errno
import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import pytest

from tests import profiles
from tests.stages import disk_calls
from tests.stages.disk_calls import CrashState, crash_states, end_state, read_record
from tests.stages.disk_worker import ALL, HALF, KILL, KILL_TORN, RESULTS, WRITERS, CarelessWriter

EVERY: Final = 211
"""Of the faults tried in profile ``ci``; a prime, so that all calls and kinds of faults have their turn."""
POINTS_MIN: Final = 2000
"""Power cuts and faults, of all writers together, in profile ``full``; half of them in ``ci``."""

pytestmark = pytest.mark.timeout(1800)  # of the writers, all points of profile ``full`` together


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder with the records and results of all writers."""
    folder = tmp_path_factory.mktemp("written")
    disk_calls.run_worker(disk_calls.build(folder), folder, "1" if profiles.is_full() else str(EVERY))
    return folder


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def power_cuts(written: Path, name: str) -> list[CrashState]:
    record = read_record((written / f"{name}.record").read_text())
    return list(crash_states(files_in(written / f"{name}.before"), record))


def wrong_states(written: Path, name: str, folder: Path) -> list[str]:
    """Return the power cuts after which neither what was done nor what was begun is found."""
    wrong: list[str] = []
    known: dict[tuple[tuple[str, bytes], ...], list[int]] = {}
    for state in power_cuts(written, name):
        key = tuple(sorted(state.files.items()))
        if key not in known:
            known[key] = read_from(state.files, folder / name, name)
        if not any(state.done <= version <= state.begun for version in known[key]):
            wrong.append(f"{name}, {state.changes} changes, {state.how}: {known[key]}, {state.done} done")
    return wrong


def read_from(files: Mapping[str, bytes], folder: Path, name: str) -> list[int]:
    folder.mkdir(exist_ok=True)
    for path in folder.iterdir():
        path.unlink()
    for file, data in files.items():
        (folder / file).write_bytes(data)
    return ALL[name].read(folder)


def results(written: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (written / RESULTS).read_text().splitlines()]


@pytest.mark.parametrize("name", WRITERS)
def test_the_record_is_all_that_was_done(written: Path, name: str) -> None:
    record = read_record((written / f"{name}.record").read_text())
    assert end_state(files_in(written / f"{name}.before"), record) == files_in(written / f"{name}.after")


@pytest.mark.parametrize("name", WRITERS)
def test_a_power_cut_leaves_the_old_or_the_new(written: Path, tmp_path: Path, name: str) -> None:
    """Failed before for uploads: the last name was not yet on the disk when the client was told it is."""
    assert wrong_states(written, name, tmp_path) == []


def test_a_job_in_the_journal_is_never_more_than_a_few_lines_behind(written: Path, tmp_path: Path) -> None:
    """Failed before: entries came more often than the pause after which they were synced, so none was."""
    behind = []
    for state in power_cuts(written, "journal"):
        if 10 < state.begun < WRITERS["journal"].versions and state.how.endswith("synced content"):
            found = read_from(state.files, tmp_path / "journal", "journal")
            behind.append(state.begun - min(found))
    assert behind
    # Notes are queued faster here than the thread writes, so what counts is what was written, not begun.
    record = read_record((written / "journal.record").read_text())
    appended = 0
    for change in record:
        appended = 0 if change.kind in ("sync", "rename") else appended + (change.kind == "write")
        assert appended <= 3


def test_the_model_finds_a_careless_writer(written: Path, tmp_path: Path) -> None:
    assert len(wrong_states(written, CarelessWriter.name, tmp_path)) > 2


@pytest.mark.parametrize("name", WRITERS)
def test_a_failing_disk_is_reported_and_leaves_the_old_or_the_new(written: Path, name: str) -> None:
    """Failed before for the journal: half an entry spoiled the next, so that jobs that ended were offered."""
    points = [point for point in results(written) if point["writer"] == name]
    versions = WRITERS[name].versions
    assert len(points) >= 3
    for point in points:
        found = point["found"]
        assert found != [HALF], point
        assert any(version <= point["begun"] for version in found), point
        if point["mode"] not in (KILL, KILL_TORN):
            assert point["sentence"] or versions in found, point
            assert "Traceback" not in point["sentence"]
            assert "\n" not in point["sentence"]
        if name != "journal":
            assert any(version >= point["done"] for version in found), point
        elif point["mode"] not in (KILL, KILL_TORN) and point["error"] != errno.EROFS:
            assert versions in found, f"a job that ended is not offered again: {point}"
        assert versions in point["then"], point
        assert not [name for name in point["left"] if name.endswith(".part")], point


def test_enough_was_tried(written: Path) -> None:
    counted = Counter({name: len(power_cuts(written, name)) for name in WRITERS})
    counted["faults"] = len(results(written))
    assert counted.total() >= (POINTS_MIN if profiles.is_full() else POINTS_MIN // 2), counted

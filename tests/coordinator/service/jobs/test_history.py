"""The history of jobs: bounded, kept in a file, and proof against what the file may hold."""

import asyncio
import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from coordinator.service.jobs.history import HISTORY_MAX, EndedJob, JobHistory
from coordinator.support.file_writer import FileWriter

JOB = EndedJob(
    file="a.gcode",
    state="done",
    message="",
    ended_s=1.7e9,
    elapsed_s=61.5,
    print_time_s=60.0,
    filament_mm=812.5,
)


PATIENCE_S = 60.0


def kept(path: Path) -> JobHistory:
    history = JobHistory(pytest.fail, FileWriter())
    history.open(path)
    return history


def test_it_keeps_the_newest_jobs_in_its_file(tmp_path: Path) -> None:
    path = tmp_path / "history"
    jobs = [replace(JOB, file=f"{n}.gcode") for n in range(HISTORY_MAX + 2)]

    async def go() -> None:
        history = JobHistory(pytest.fail, files := FileWriter())
        history.add(jobs[0])  # before there is a file
        history.open(path)
        for job in jobs[1:]:
            history.add(job)
        assert await asyncio.to_thread(files.wait, PATIENCE_S)
        assert history.jobs == jobs[:1:-1]

    asyncio.run(go())
    assert kept(path).jobs == jobs[:1:-1]


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        "7",
        "[7]",
        "[" * 100_000,
        json.dumps([asdict(JOB) | {"file": 7}]),
        json.dumps([asdict(JOB) | {"ended_s": "7"}]),
        json.dumps([asdict(JOB) | {"ended_s": float("nan")}]),
        json.dumps([{"file": "a.gcode"}]),
    ],
)
def test_what_is_no_job_is_left_out(tmp_path: Path, content: str) -> None:
    path = tmp_path / "history"
    path.write_text(content)
    assert kept(path).jobs == []
    if content.startswith("[{"):
        path.write_text(json.dumps([asdict(JOB), *json.loads(content)]))
        assert kept(path).jobs == [JOB]


def test_a_file_that_cannot_be_written_is_reported_and_forgets_nothing(tmp_path: Path) -> None:
    reports: list[str] = []

    async def go() -> None:
        history = JobHistory(reports.append, files := FileWriter())
        history.open(tmp_path / "missing" / "history")
        history.add(JOB)
        assert await asyncio.to_thread(files.wait, PATIENCE_S)
        assert history.jobs == [JOB]

    asyncio.run(go())
    (report,) = reports
    assert report.startswith("the history of jobs cannot be written to")

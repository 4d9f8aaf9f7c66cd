"""No name that a client can send opens anything but a regular file of the job folder."""

import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.service.jobs.job_folder import JobFolder, NoSuchJob
from tests.profiles import examples


@pytest.fixture
def folder(tmp_path: Path) -> JobFolder:
    jobs = tmp_path / "jobs"
    (jobs / "parts" / "small").mkdir(parents=True)
    (jobs / "a.gcode").write_text("G28\n")
    (jobs / "parts" / "small" / "b.NC").write_text("G28\nG1 X1\n")
    (jobs / "parts" / "notes.txt").write_text("no job")
    (jobs / ".hidden.gcode").write_text("G28\n")
    (tmp_path / "secret.gcode").write_text("M112\n")
    (jobs / "link.gcode").symlink_to(tmp_path / "secret.gcode")
    (jobs / "out").symlink_to(tmp_path)
    os.mkfifo(jobs / "pipe.gcode")
    return JobFolder(jobs)


def test_lists_jobs_by_name_and_nothing_else(folder: JobFolder) -> None:
    assert [(job.name, job.size_bytes) for job in folder.files()] == [
        ("a.gcode", 4),
        ("parts/small/b.NC", 10),
    ]


@pytest.mark.parametrize("name", ["a.gcode", "parts/small/b.NC"])
def test_opens_a_job(folder: JobFolder, name: str) -> None:
    with folder.open(name) as program:
        assert program.refill()
        assert program.data.startswith(b"G28\n")
        assert program.size_bytes == len(program.data)


@pytest.mark.parametrize(
    "name",
    [
        "",
        ".",
        "./a.gcode",
        "parts//small/b.NC",
        "..",
        "../secret.gcode",
        "parts/../../secret.gcode",
        "/etc/passwd",
        "//etc/passwd",
        "link.gcode",
        "out/secret.gcode",
        "out/jobs/a.gcode",
        "pipe.gcode",
        "parts",
        ".hidden.gcode",
        "a.gcode\0",
        "a\n.gcode",
        "..\\secret.gcode",
        "a.gcode/b",
        "x" * 5000,
        "/".join("abcdefghij"),
        "\ud800",
        "%s%n{0}",
    ],
)
def test_refuses_in_one_sentence(folder: JobFolder, name: str) -> None:
    with pytest.raises(NoSuchJob) as error:
        folder.open(name)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300


@settings(max_examples=examples(300))
@given(
    parts=st.lists(
        st.sampled_from(["..", ".", "", "a", "out", "jobs", "secret.gcode", "/", "~", "\0"]), max_size=6
    )
)
def test_never_leaves_the_folder(tmp_path_factory: pytest.TempPathFactory, parts: list[str]) -> None:
    base = tmp_path_factory.getbasetemp() / "never"
    jobs = base / "jobs"
    if not jobs.exists():
        jobs.mkdir(parents=True)
        (base / "secret.gcode").write_text("M112\n")
        (jobs / "out").symlink_to(base)
    with pytest.raises(NoSuchJob):
        JobFolder(jobs).open("/".join(parts)).close()


def test_a_missing_folder_is_told(tmp_path: Path) -> None:
    for ask in (JobFolder(tmp_path / "none").files, lambda: JobFolder(tmp_path / "none").open("a.gcode")):
        with pytest.raises(NoSuchJob, match="cannot be read: no such file"):
            ask()


def test_descriptors_are_given_back(folder: JobFolder) -> None:
    before = len(list(Path("/proc/self/fd").iterdir()))
    for name in ("a.gcode", "parts/small/b.NC"):
        folder.open(name).close()
    for name in ("link.gcode", "out/secret.gcode", "parts", "pipe.gcode", "none"):
        with pytest.raises(NoSuchJob):
            folder.open(name)
    folder.files()
    assert len(list(Path("/proc/self/fd").iterdir())) == before

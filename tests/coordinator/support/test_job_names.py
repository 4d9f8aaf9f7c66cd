"""Names of job files: uploads, the job folder and the command line take the same."""

from pathlib import Path

import pytest

from coordinator.ipc.protocol.methods import ApiError
from coordinator.ipc.server.uploads import _check_name
from coordinator.service.jobs.job_folder import JobFolder, NoSuchJob
from coordinator.support.job_names import NAME_BYTES_MAX, is_job_name, job_path_parts

GOOD = ("a.gcode", "part (2) – ü.GCODE", "x.nc", "é" * 117 + ".gcode", "a..gcode", "a*b.gcode")  # noqa: RUF001
BAD = ("", ".gcode", ".a.gcode", "-a.gcode", " a.gcode", "a", "a.txt", "a\\b.gcode", "a\x1b.gcode",
       "a\n.gcode", "a\u202e.gcode", "é" * 118 + ".gcode", "\ud800.gcode", "a\x7f.gcode",
       "a;b.gcode")  # fmt: skip


@pytest.mark.parametrize("name", GOOD)
def test_good_names_go_all_ways(tmp_path: Path, name: str) -> None:
    """Failed before for long ones: 128 characters may be more bytes than a disk takes."""
    assert len(name.encode()) <= NAME_BYTES_MAX
    _check_name(name)
    (tmp_path / f".{name}.part").touch()
    (tmp_path / name).write_text("G28\n")
    folder = JobFolder(tmp_path)
    assert [job.name for job in folder.files()] == [name]
    folder.open(name).close()
    assert job_path_parts(f"a/{name}") == ("a", name)


@pytest.mark.parametrize("name", BAD)
def test_bad_names_go_no_way(tmp_path: Path, name: str) -> None:
    """Failed before: a backslash could be uploaded, but not printed; a name without a suffix the reverse."""
    assert not is_job_name(name)
    with pytest.raises(ApiError):
        _check_name(name)
    with pytest.raises(NoSuchJob):
        JobFolder(tmp_path).open(name)


@pytest.mark.parametrize("path", ["./a.gcode", "a.gcode/", "/a.gcode", "sub//a.gcode", "sub/./a.gcode"])
def test_a_path_has_one_spelling(path: str) -> None:
    """Failed before: job.start took what job.upload refused."""
    assert not job_path_parts(path)
    assert job_path_parts("sub/a.gcode") == ("sub", "a.gcode")

"""Two services on one job folder: the second reports it, and touches nothing."""

from pathlib import Path

import pytest

from coordinator.front_ends.serve import ServeOptions, serve
from coordinator.service.jobs.job_folder import JobFolderClaim, JobFolderInUse


def test_the_second_one_reports_it_and_removes_no_upload(tmp_path: Path) -> None:
    """Failed before: it began, removed the uploads of the first one, and both wrote one journal."""
    claim, part = JobFolderClaim(tmp_path), tmp_path / ".a.gcode.part"
    part.touch()
    options = ServeOptions(name="second", path=tmp_path / "second.sock", jobs=tmp_path)
    with pytest.raises(JobFolderInUse, match="is used by another service; end that one"):
        serve(pytest.fail, options)
    assert part.exists()
    claim.close()
    JobFolderClaim(tmp_path).close()


def test_a_folder_that_is_not_there_is_no_reason_to_refuse(tmp_path: Path) -> None:
    JobFolderClaim(tmp_path / "none").close()

"""The terminal of a service in the background of a shell."""

import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[4]


@pytest.mark.parametrize("case", ["typed", "late", "writes"])
def test_a_shell_does_not_stop_a_service_in_its_background(case: str) -> None:
    """Failed before: SIGTTIN stopped it when somebody typed, SIGTTOU with ``stty tostop`` when it wrote."""
    user, terminal = pty.openpty()
    os.write(user, b"M114\n")
    command = [sys.executable, "-m", "tests.stages.background_job", case]
    with os.fdopen(user, "rb", buffering=0), os.fdopen(terminal, "rb", buffering=0) as stdin:
        ended = subprocess.run(
            command,
            cwd=ROOT,
            stdin=stdin,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            timeout=60,
            check=False,
        )
    assert (ended.returncode, ended.stderr) == (0, "")

"""The folder of a demo's step logs."""

from pathlib import Path

import pytest

from coordinator.demo.run import DemoOptions, run_demo
from nodes.support.errors import CanductorError


@pytest.mark.parametrize("below", ["", "logs"])
def test_a_file_is_no_folder_for_step_logs(tmp_path: Path, below: str) -> None:
    file = tmp_path / "a.gcode"
    file.touch()
    with pytest.raises(CanductorError, match="cannot keep the step logs"):
        run_demo(DemoOptions(keep=file / below))
    assert file.is_file()

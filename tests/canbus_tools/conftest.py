"""The simulated bus that the tools are tested on."""

from pathlib import Path

import pytest

from tests.canbus_tools.command import Command
from tests.stages.can_stage import CanStage, SixNodes, six_nodes
from tests.stages.own_sockets import own_sockets


@pytest.fixture
def stage() -> CanStage:
    """Return a bus with nobody on it, in virtual time."""
    return CanStage()


@pytest.fixture
def six(stage: CanStage) -> SixNodes:
    """Return the bus with the six nodes of can_stage.py."""
    return six_nodes(stage)


@pytest.fixture(autouse=True)
def no_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the user's cache of dictionaries, and the machines that the user runs, out of it."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    own_sockets(monkeypatch, tmp_path / "run")


@pytest.fixture
def can_tool(stage: CanStage, capsys: pytest.CaptureFixture[str]) -> Command:
    """Return what runs ``canductor can`` on the bus of the test."""
    return Command(stage.computer, capsys, stage.words)

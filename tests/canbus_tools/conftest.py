"""The bus and the stage that the tools are tested on."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.canbus_tools.command import Command
from tests.canbus_tools.stage import Place, Stage, any_place, six_nodes


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Place]:
    """Yield a bus with nobody on it: vcan0 where there is one, else a virtual bus."""
    with any_place(tmp_path) as found:
        yield found


@pytest.fixture
def stage(place: Place) -> Iterator[Stage]:
    """Yield the six nodes of stage.py."""
    with six_nodes(place) as nodes:
        yield nodes


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the user's cache of dictionaries out of it."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def can_tool(place: Place, capsys: pytest.CaptureFixture[str]) -> Command:
    """Return what runs ``canductor can`` on the bus of the test."""
    return Command(place, capsys)

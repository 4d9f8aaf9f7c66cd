"""Hardware in processes of its own."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.stages.processes import Hardware, hardware


@pytest.fixture(autouse=True)
def own_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep what commands write out of the user's home."""
    for name in ("XDG_CACHE_HOME", "XDG_STATE_HOME", "XDG_RUNTIME_DIR"):
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
        (tmp_path / name.lower()).mkdir(mode=0o700)


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hardware]:
    """Start nodes that all tests of a module use, one command after the other."""
    with hardware(tmp_path_factory.mktemp("hardware")) as started:
        yield started


@pytest.fixture
def own_machine(tmp_path: Path) -> Iterator[Hardware]:
    """Start nodes that the test may kill."""
    with hardware(tmp_path) as started:
        yield started

"""Hardware in processes of its own."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.stages.processes import Hardware, hardware


@pytest.fixture(autouse=True)
def own_folders(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Keep what commands write out of the user's home; in a short path, as that of a socket has 107 bytes."""
    with tempfile.TemporaryDirectory() as folder:
        for name in ("XDG_CACHE_HOME", "XDG_STATE_HOME", "XDG_RUNTIME_DIR"):
            monkeypatch.setenv(name, f"{folder}/{name}")
            Path(folder, name).mkdir(mode=0o700)
        yield


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

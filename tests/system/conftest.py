from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.stages.processes import Hardware, hardware
from tests.system.patiently import be_patient


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep what commands cache out of the user's home."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give machines in this process as much time as those in processes of their own have."""
    be_patient(monkeypatch.setattr)


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Hardware]:
    with hardware(tmp_path) as started:
        yield started

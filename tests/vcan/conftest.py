"""What holds for all tests on the kernel's CAN."""

from pathlib import Path

import pytest

from tests.system.patiently import be_patient


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have dictionaries downloaded: where frames get lost, some of those are."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give machines in this process as much time as those in processes of their own have."""
    be_patient(monkeypatch.setattr)

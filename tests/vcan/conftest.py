"""What holds for all tests on the kernel's CAN."""

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have dictionaries downloaded: where frames get lost, some of those are."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

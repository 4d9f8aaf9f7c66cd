"""What holds for all tests on the kernel's CAN."""

from pathlib import Path

import pytest

from tests.stages.own_sockets import own_sockets


@pytest.fixture(autouse=True)
def no_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the user's cache of dictionaries, and the machines that the user runs, out of it."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    own_sockets(monkeypatch, tmp_path / "run")

"""A folder where a test's machines are found, and those of the user who runs it are not."""

from pathlib import Path

import pytest


def own_sockets(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Let machines be looked for in FOLDER/canductor alone, and make it as a service does."""
    (folder / "canductor").mkdir(mode=0o700, parents=True, exist_ok=True)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    monkeypatch.setattr("nodes.support.host_sockets.SYSTEM_FOLDERS", ())

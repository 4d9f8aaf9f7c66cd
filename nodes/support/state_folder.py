"""Folder of the persistent state of this user's machines."""

import os
import re
from pathlib import Path


def state_folder(machine: str) -> Path:
    """Return the folder of MACHINE below XDG_STATE_HOME, by default ~/.local/state; it may not exist yet."""
    base = os.environ.get("XDG_STATE_HOME", "")
    root = Path(base) if base.startswith("/") else Path.home() / ".local" / "state"
    return root / "canductor" / (re.sub(r"[^A-Za-z0-9_-]", "_", machine) or "machine")

"""Folder of the persistent state of this user's machines."""

import re
from pathlib import Path

from nodes.support.user_folder import user_folder


def state_folder(machine: str) -> Path:
    """Return the folder of MACHINE below XDG_STATE_HOME, by default ~/.local/state; it may not exist yet.

    Raises CanductorError.
    """
    root = user_folder("XDG_STATE_HOME", ".local", "state")
    return root / "canductor" / (re.sub(r"[^A-Za-z0-9_-]", "_", machine) or "machine")

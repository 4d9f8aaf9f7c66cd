"""The sockets of this user's machines."""

import os
import tempfile
from pathlib import Path


def socket_folder() -> Path:
    """Return the folder of the sockets of this user's machines."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    return Path(base) / "canductor" if base else Path(tempfile.gettempdir()) / f"canductor-{os.geteuid()}"


def host_sockets() -> list[Path]:
    """Return the paths of the sockets of this user's machines; their processes may have ended."""
    return sorted(path for path in socket_folder().glob("*.sock") if path.is_socket())

"""The sockets of this user's machines."""

import os
import tempfile
from pathlib import Path


def socket_folder() -> Path:
    """Return where this user's machines have their sockets."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    return Path(base) / "canductor" if base else Path(tempfile.gettempdir()) / f"canductor-{os.geteuid()}"


def host_sockets() -> list[Path]:
    """Return the sockets of this user's machines; their programs may have ended."""
    return sorted(path for path in socket_folder().glob("*.sock") if path.is_socket())

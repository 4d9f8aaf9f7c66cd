"""Internal errors: their traceback goes to a file, since it helps nobody on a terminal or a display."""

import sys
import tempfile
import traceback

from coordinator.support.version import VERSION


def log_bug(error: BaseException) -> str:
    """Write ERROR with its traceback to a new temporary file; return a sentence that names the file."""
    said = " ".join(f"internal error: {type(error).__name__}: {error}; please report it".split())
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="canductor-", suffix=".log", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as log:
            log.write(f"canductor {VERSION}, Python {sys.version}\n{' '.join(sys.argv)}\n\n")
            log.write("".join(traceback.format_exception(error)))
    except OSError as refused:
        return f"{said}; its traceback could not be written: {(refused.strerror or str(refused)).lower()}"
    return f"{said} with {log.name}"

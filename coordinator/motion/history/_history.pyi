"""cffi module; the functions are documented in coordinator/motion/history/history.h."""

from typing import Any

import cffi

ffi: cffi.FFI
lib: Any
"""What planned moves do, looked at as a whole (C)."""

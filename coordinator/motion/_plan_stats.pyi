"""cffi module; the functions are documented in coordinator/motion/plan_stats.h."""

from typing import Any

import cffi

ffi: cffi.FFI
lib: Any

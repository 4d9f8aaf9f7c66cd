"""cffi module; the functions are documented in coordinator/motion/stats/plan_stats.h."""

from typing import Any

import cffi

ffi: cffi.FFI
lib: Any

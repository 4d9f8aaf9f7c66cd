"""cffi module; the functions are documented in coordinator/motion/steps/steps.h."""

from typing import Any

import cffi

ffi: cffi.FFI
lib: Any

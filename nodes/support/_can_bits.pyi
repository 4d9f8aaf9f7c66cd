"""cffi module; the functions are documented in nodes/support/can_bits.h."""

from typing import Any

import cffi

ffi: cffi.FFI
lib: Any

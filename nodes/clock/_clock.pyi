"""cffi module; the functions are documented in linear.h and normal.h."""

from typing import Any

import cffi

ffi: cffi.FFI
lib: Any

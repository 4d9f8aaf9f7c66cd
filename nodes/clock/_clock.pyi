"""cffi module; the functions are documented in linear.h, normal.h, start_fit.h and pulse_parabola.h."""

from typing import Any

import cffi

ffi: cffi.FFI
lib: Any

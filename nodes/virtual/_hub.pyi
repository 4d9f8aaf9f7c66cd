"""cffi module; the functions are documented in hub.h and hub_loop.h."""

from typing import Any

import cffi

ffi: cffi.FFI
lib: Any

"""cffi module; the functions are documented in link.h, io_core.h, io_api.h and io_thread.h."""

from typing import Any

import cffi

ffi: cffi.FFI
lib: Any

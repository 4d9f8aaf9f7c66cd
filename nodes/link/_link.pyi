"""cffi module; the functions are documented in nodes/link/link.h and nodes/link/io_thread.h."""

from typing import Any

import cffi

ffi: cffi.FFI
lib: Any

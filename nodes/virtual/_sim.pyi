"""cffi module; the functions are documented in firmware/boards/sim/sim.h."""

from typing import Any

import cffi

ffi: cffi.FFI
lib: Any

"""cffi module; the functions are documented in firmware/wire/wire.h and message_values.h."""

from typing import Any

import cffi

ffi: cffi.FFI
lib: Any

"""cffi module; documented in coordinator/motion/{planner_queue,gcode_lines,trapezoid}.h."""

from typing import Any

import cffi

ffi: cffi.FFI
lib: Any

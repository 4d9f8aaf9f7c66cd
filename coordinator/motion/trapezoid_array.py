"""struct trapezoid as numpy sees it: for proofs and tests, as planning itself needs no numpy."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from coordinator.motion.planner._planner import ffi

_FORMATS: Mapping[str, Any] = {"double": "f8", "double[4]": ("f8", 4), "int64_t": "i8"}


def _trapezoid_dtype() -> np.dtype[np.void]:
    """Describe struct trapezoid to numpy, with the offsets the compiler chose."""
    layout = dict(ffi.typeof("struct trapezoid").fields)
    return np.dtype(
        {
            "names": list(layout),
            "formats": [_FORMATS[field.type.cname] for field in layout.values()],
            "offsets": [field.offset for field in layout.values()],
            "itemsize": ffi.sizeof("struct trapezoid"),
        }
    )


TRAPEZOID = _trapezoid_dtype()
"""struct trapezoid as a numpy dtype."""

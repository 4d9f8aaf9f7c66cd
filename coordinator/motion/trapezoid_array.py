"""struct trapezoid as numpy sees it: for proofs, plans and tests; what always runs needs no numpy."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from coordinator.motion.planner._planner import ffi
from coordinator.motion.planner.values import Trapezoids

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


def array_of(trapezoids: Trapezoids) -> npt.NDArray[np.void]:
    """Return a view (dtype TRAPEZOID) of the planner's memory."""
    return np.frombuffer(trapezoids.memory, TRAPEZOID, trapezoids.count, trapezoids.offset)

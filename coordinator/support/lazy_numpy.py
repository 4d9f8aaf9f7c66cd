"""numpy as ``np``, imported when it is first used.

It takes 10 MB of memory, which a machine that prints does not need: only calibrations calculate with it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__all__ = ("Numbers", "np")

if TYPE_CHECKING:
    import numpy as np

    Numbers = np.ndarray[Any, np.dtype[np.float64]]
else:

    class _LazyNumpy:
        def __getattr__(self, name: str) -> Any:
            return getattr(import_module("numpy"), name)

    np = _LazyNumpy()
    Numbers = Any

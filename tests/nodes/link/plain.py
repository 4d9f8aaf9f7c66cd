"""What a C struct says, as values of Python."""

from types import SimpleNamespace
from typing import Any

from nodes.link._link import ffi


def plain(value: Any) -> Any:
    """Return a struct, or what a pointer points to, as an object with the same names, and arrays as lists.

    A part of a struct that cffi returns does not keep the struct's memory: read later, it is of chance.
    """
    if not isinstance(value, ffi.CData):
        return value
    kind = ffi.typeof(value)
    if kind.kind == "pointer":
        return plain(value[0])
    if kind.kind == "array":
        return [plain(item) for item in value]
    return SimpleNamespace(**{name: plain(getattr(value, name)) for name, _ in kind.fields})

"""Conversion of C structs to dataclasses, by the fields of the cffi declaration."""

from dataclasses import fields
from functools import cache
from typing import Any, TypeVar

from _cffi_backend import typeof  # not cffi.FFI: that imports a parser of C

T = TypeVar("T")


def field_names(struct: Any) -> list[str]:
    """Return the names of the fields of a struct, or of what a pointer points to."""
    kind = typeof(struct)
    kind = kind.item if kind.kind == "pointer" else kind
    return [name for name, _ in kind.fields or ()]


def from_struct(kind: type[T], struct: Any, **others: Any) -> T:
    """Return a dataclass KIND with the values of the fields of the same names in STRUCT, and with OTHERS.

    Raises TypeError when a field without a default is in neither.
    """
    names = _common_names(kind, typeof(struct))  # type: ignore[arg-type]  # classes are hashable
    return kind(**{name: getattr(struct, name) for name in names} | others)


@cache
def _common_names(kind: Any, struct: Any) -> tuple[str, ...]:
    """Return the fields that a dataclass and a C type have both; there are about a dozen such pairs."""
    names = {field.name for field in fields(kind)}
    found = struct.item if struct.kind == "pointer" else struct
    return tuple(name for name, _ in found.fields or () if name in names)

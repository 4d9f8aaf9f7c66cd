"""``record``: a frozen dataclass with slots that costs a start-up next to nothing.

``dataclass(frozen=True, slots=True)`` compiles six methods for every class imported, in some 0.7 ms: for
the classes of a short plan that was a fifth of all its CPU time. Here five methods are common to all classes
and the constructor is compiled when there are a few instances. Everything else is the dataclass it replaces:
fields, defaults, ``field``, ``replace``, ``asdict``, ``match``, ``__post_init__``, pickling. With
``frozen=False`` it may be changed, and has no hash.

A record may only inherit from records. Comparing, hashing and showing loop over the fields: use a dataclass
where that is done millions of times.
"""

from collections.abc import Callable
from dataclasses import MISSING, FrozenInstanceError, dataclass, field, fields
from typing import Any, TypeVar, dataclass_transform, overload

T = TypeVar("T")


@overload
def record(cls: type[T], /) -> type[T]: ...
@overload
def record(*, kw_only: bool = False, frozen: bool = True) -> Callable[[type[T]], type[T]]: ...
@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def record(
    cls: type[T] | None = None, /, *, kw_only: bool = False, frozen: bool = True
) -> type[T] | Callable[[type[T]], type[T]]:
    """Make CLS a record; KW_ONLY: its own fields are given by name; not FROZEN: they may be set."""

    def make(plain: type[T]) -> type[T]:
        plain.__doc__ = plain.__doc__ or plain.__name__  # dataclass would import half a parser to make one
        made = dataclass(plain, init=False, repr=False, eq=False, slots=True, kw_only=kw_only)
        own = vars(made)
        for name, method in (_METHODS if frozen else _CHANGEABLE).items():
            if name not in own or (name == "__hash__" and own[name] is None):
                setattr(made, name, method)
        made.__init__ = _first_init(made, frozen=frozen)  # type: ignore[method-assign]
        return made

    return make if cls is None else make(cls)


# --------------------------------------------------------------------------------------------- constructor


_FILLED_FIRST = 16
"""Instances whose fields take less time to fill one by one than a constructor to compile."""


def _first_init(cls: type, *, frozen: bool) -> Callable[..., None]:
    """Return a constructor that puts the real one into its place, when there are many or words do not fit."""
    left = _FILLED_FIRST

    def __init__(self: Any, /, *args: Any, **kwargs: Any) -> None:  # noqa: N807 (it is one)
        nonlocal left
        left -= 1
        if left > 0 and _fill(cls, self, args, kwargs):
            if hasattr(cls, "__post_init__"):
                self.__post_init__()
            return
        init = _compile_init(cls, frozen=frozen)
        cls.__init__ = init  # type: ignore[misc]
        init(self, *args, **kwargs)

    return __init__


def _fill(cls: type, made: object, args: tuple[Any, ...], kwargs: dict[str, Any]) -> bool:
    """Set the fields of MADE as the compiled constructor would; returns whether the words fit."""
    by_place, by_name = list(reversed(args)), dict(kwargs)
    for entry in fields(cls):
        name = entry.name
        if by_place and entry.init and not entry.kw_only:
            value = by_place.pop()
        elif entry.init and name in by_name:
            value = by_name.pop(name)
        elif entry.default is not MISSING:
            value = entry.default
        elif entry.default_factory is not MISSING:
            value = entry.default_factory()
        else:
            return False
        object.__setattr__(made, name, value)
    return not by_place and not by_name


def _compile_init(cls: type, *, frozen: bool) -> Callable[..., None]:
    names: dict[str, Any] = {"_set": object.__setattr__, "_MISSING": MISSING}
    positional: list[str] = []
    by_name: list[str] = []
    body: list[str] = []
    for entry in fields(cls):
        name, value = entry.name, entry.name
        parameter = name
        if entry.default_factory is not MISSING:
            names[f"_make_{name}"] = entry.default_factory
            parameter = f"{name}=_MISSING"
            value = f"_make_{name}() if {name} is _MISSING else {name}"
        elif entry.default is not MISSING:
            names[f"_default_{name}"] = entry.default
            parameter = f"{name}=_default_{name}"
        if entry.init:
            (by_name if entry.kw_only else positional).append(parameter)
        else:
            value = f"_make_{name}()" if entry.default_factory is not MISSING else f"_default_{name}"
        body.append(f"    _set(self, {name!r}, {value})" if frozen else f"    self.{name} = {value}")
    if hasattr(cls, "__post_init__"):
        body.append("    self.__post_init__()")
    parameters = ", ".join(["self", *positional, *(["*", *by_name] if by_name else [])])
    text = "\n".join([f"def __init__({parameters}):", *body, "    return None"])
    exec(text, names)  # noqa: S102 (as dataclasses does; the names are those of attributes)
    init: Callable[..., None] = names["__init__"]
    init.__qualname__ = f"{cls.__qualname__}.__init__"
    return init


# ---------------------------------------------------------------------------------------- common to all


def _values(self: Any) -> tuple[Any, ...]:
    return tuple(getattr(self, name) for name in self.__dataclass_fields__)


def _compared(self: Any) -> tuple[Any, ...]:
    return tuple(getattr(self, name) for name, f in self.__dataclass_fields__.items() if f.compare)


def _eq(self: Any, other: object) -> Any:
    if type(other) is not type(self):
        return NotImplemented
    return _compared(self) == _compared(other)


def _hash(self: Any) -> int:
    return hash(_compared(self))


def _repr(self: Any) -> str:
    shown = (f"{name}={getattr(self, name)!r}" for name, f in self.__dataclass_fields__.items() if f.repr)
    return f"{self.__class__.__qualname__}({', '.join(shown)})"


def _refuse_set(self: object, name: str, value: object) -> None:
    del self, value
    raise FrozenInstanceError(f"cannot assign to field {name!r}")


def _refuse_delete(self: object, name: str) -> None:
    del self
    raise FrozenInstanceError(f"cannot delete field {name!r}")


def _set_state(self: Any, state: tuple[Any, ...]) -> None:
    for name, value in zip(self.__dataclass_fields__, state, strict=True):
        object.__setattr__(self, name, value)


_CHANGEABLE: dict[str, Callable[..., Any] | None] = {
    "__eq__": _eq,
    "__hash__": None,
    "__repr__": _repr,
    "__getstate__": _values,
    "__setstate__": _set_state,
}
_METHODS: dict[str, Callable[..., Any] | None] = _CHANGEABLE | {
    "__hash__": _hash,
    "__setattr__": _refuse_set,
    "__delattr__": _refuse_delete,
}

"""Methods that front ends may call: who may, what they take, what they give; and their check of what came."""

import math
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum, StrEnum
from typing import Any, Final

from coordinator.support.values import Value
from nodes.support.errors import CanductorError
from nodes.support.terminal import printable

INT_MIN: Final = -(2**63)
INT_MAX: Final = 2**63 - 1
STR_MAX: Final = 65_536
"""Characters of a string parameter that declares no other limit."""


class Scope(IntEnum):
    """What a caller may do; each includes those before it."""

    WATCH = 1
    """See the machine, change nothing."""
    OPERATE = 2
    """Also print, move and stop it."""
    ADMIN = 3
    """Also what can harm it: raw commands to nodes."""

    @property
    def word(self) -> str:
        """The scope as messages and the tokens' file write it."""
        return self.name.lower()


class ApiError(CanductorError):
    """A call that failed; CODE is for programs and stays the same, SENTENCE is for people.

    Codes are words of a-z and _; all in use are in the tables of docs/ipc.md.
    """

    def __init__(self, code: str, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code

    @property
    def sentence(self) -> str:
        """What went wrong and what to do about it."""
        return str(self)


class Kind(StrEnum):
    """Types of parameters and results."""

    BOOL = "bool"
    INT = "int"
    FLOAT = "float"
    """A finite number; whole ones are taken too."""
    STR = "str"
    LIST = "list"
    MAP = "map"
    ANY = "any"


@dataclass(frozen=True, slots=True)
class Param:
    """One parameter of a method, or one field of its result.

    LOW and HIGH bound numbers, HIGH also the length of strings and lists. A parameter that is not required
    and not given arrives as DEFAULT; where that is None, null may be given too.
    """

    name: str
    kind: Kind
    sentence: str = ""
    unit: str = ""
    required: bool = True
    default: Value = None
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()

    def schema(self) -> dict[str, Value]:
        """Return the declaration as "api.methods" shows it; defaults are left out."""
        schema: dict[str, Value] = {"name": self.name, "kind": self.kind.value, "sentence": self.sentence}
        if self.unit:
            schema["unit"] = self.unit
        if not self.required:
            schema |= {"required": False, "default": self.default}
        for name, bound in (("low", self.low), ("high", self.high)):
            if bound is not None:
                schema[name] = bound
        if self.choices:
            schema["choices"] = list(self.choices)
        return schema


@dataclass(frozen=True, slots=True)
class Caller:
    """Who calls: NAME is the program's, for people, and is never trusted for more."""

    name: str
    scope: Scope
    at_end: list[Callable[["Caller"], None]] = field(default_factory=list, compare=False, repr=False)
    """Called on the control loop when the client has left; what a method keeps for it goes then."""


Call = Callable[[Caller, dict[str, Any]], Awaitable[Value] | Value]
"""Gets every declared parameter, checked, defaults filled in. Runs on the control loop and must never block.
A plain function is answered at once, which is the fastest; a coroutine runs as a task, which is cancelled
when its caller leaves or cancels the request. Raises CanductorError; ApiError where the code matters."""


def _stops_nothing(_caller: Caller, _params: dict[str, Any]) -> str | None:
    pass


@dataclass(frozen=True, slots=True)
class Method:
    """A method of the interface."""

    name: str
    scope: Scope
    sentence: str
    call: Call
    params: tuple[Param, ...] = ()
    returns: tuple[Param, ...] = ()
    """Fields of the map that it returns."""
    urgent: bool = False
    """Called while the message is received, ahead of everything that waits, and whatever is wrong with its
    parameters; must be a plain function, and require none."""
    stops: Callable[[Caller, dict[str, Any]], str | None] = _stops_nothing
    """Return whom a call with such parameters names as who stops the machine; None: it does not. In any
    thread: while the control loop is held, such a call is carried out without it (server/stop_lane.py). It is
    called as an urgent one is, and must have stopped the machine when it returns."""
    stop_words: tuple[str, ...] = ()
    """One of them is in the text of each call that is urgent or stops; empty: the method's name is."""

    def schema(self) -> dict[str, Value]:
        """Return the declaration as "api.methods" shows it."""
        return {
            "name": self.name,
            "scope": self.scope.word,
            "sentence": self.sentence,
            "params": [param.schema() for param in self.params],
            "returns": [field.schema() for field in self.returns],
        }

    def check(self, given: object) -> dict[str, Any]:
        """Return the parameters GIVEN with defaults filled in; raises ApiError (bad_params)."""
        if given is None:
            given = {}
        if not isinstance(given, dict):
            raise ApiError("bad_params", f"{self.name}: params must be a map of names and values")
        checked: dict[str, Any] = {}
        for param in self.params:
            value = given.get(param.name, _ABSENT)
            if value is not _ABSENT:
                checked[param.name] = _check(self.name, param, value)
            elif param.required:
                raise ApiError("bad_params", f"{self.name}: the parameter {param.name} is missing")
            else:
                checked[param.name] = param.default
        if not given.keys() <= checked.keys():
            known = ", ".join(checked) or "none"
            unknown = ", ".join(sorted(shown(name) for name in given.keys() - checked.keys())[:4])
            raise ApiError("bad_params", f"{self.name} has no parameter {unknown}; it takes {known}")
        return checked

    def check_urgent(self, given: object) -> tuple[dict[str, Any], str]:
        """Return the parameters GIVEN with defaults for what is wrong or missing, and what was wrong.

        That is a sentence, empty when nothing was.
        """
        try:
            return self.check(given), ""
        except ApiError as error:
            wrong = error.sentence
        usable: dict[str, Any] = {}
        for param in self.params:
            one = {param.name: given[param.name]} if isinstance(given, dict) and param.name in given else {}
            try:
                usable[param.name] = replace(self, params=(param,)).check(one)[param.name]
            except ApiError:
                usable[param.name] = param.default
        return usable, wrong


class Registry:
    """The methods of one interface, by name."""

    def __init__(self) -> None:
        self.methods: dict[str, Method] = {}
        self.stop_words: dict[Scope, tuple[bytes, ...]] = dict.fromkeys(Scope, ())
        """By a client's scope: one of them is in the text of each of its calls that is urgent or stops."""

    def add(self, method: Method) -> None:
        """Add METHOD; its name must be new."""
        assert method.name not in self.methods, method.name
        assert not (method.urgent and any(param.required for param in method.params)), method.name
        self.methods[method.name] = method
        if method.urgent or method.stops is not _stops_nothing:
            words = tuple(word.encode() for word in method.stop_words or (method.name,))
            for scope in Scope:
                if scope >= method.scope:
                    self.stop_words[scope] += words

    def schema(self) -> list[Value]:
        """Return what "api.methods" answers: every method, sorted by name."""
        return [self.methods[name].schema() for name in sorted(self.methods)]


# -------------------------------------------------------------------------------------------------- values

_ABSENT: Final = object()
_TYPES: Final[Mapping[Kind, tuple[type, ...]]] = {
    Kind.BOOL: (bool,),
    Kind.INT: (int,),
    Kind.FLOAT: (float, int),
    Kind.STR: (str,),
    Kind.LIST: (list,),
    Kind.MAP: (dict,),
}


def _check(method: str, param: Param, value: Any) -> Any:
    kind = param.kind
    if kind is Kind.ANY or (value is None and not param.required and param.default is None):
        return value
    if type(value) not in _TYPES[kind] or not _within(param, value):
        raise ApiError("bad_params", f"{method}: {param.name} is {shown(value)}, must be {rule(param)}")
    return float(value) if kind is Kind.FLOAT else value


def _within(param: Param, value: Any) -> bool:
    kind = param.kind
    if kind in (Kind.INT, Kind.FLOAT):
        low = INT_MIN if param.low is None else param.low
        high = INT_MAX if param.high is None else param.high
        return bool(low <= value <= high) and math.isfinite(value)
    if kind in (Kind.STR, Kind.LIST) and len(value) > (STR_MAX if param.high is None else param.high):
        return False
    return not param.choices or value in param.choices


def rule(param: Param) -> str:
    """Return what PARAM takes, as part of a sentence."""
    if param.choices:
        return f"one of {', '.join(param.choices)}"
    if param.kind in (Kind.INT, Kind.FLOAT):
        word = "a whole number" if param.kind is Kind.INT else "a number"
        unit = f" {param.unit}" if param.unit else ""
        if param.low is not None and param.high is not None:
            return f"{word} from {param.low:g} to {param.high:g}{unit}"
        if param.low is not None:
            return f"{word} of at least {param.low:g}{unit}"
        return f"{word} of at most {param.high:g}{unit}" if param.high is not None else f"{word}{unit}"
    words = {Kind.BOOL: "true or false", Kind.STR: "a string", Kind.LIST: "a list", Kind.MAP: "a map"}
    if param.kind in (Kind.STR, Kind.LIST):
        items = "characters" if param.kind is Kind.STR else "items"
        return f"{words[param.kind]} of at most {STR_MAX if param.high is None else param.high:g} {items}"
    return words[param.kind]


def shown(value: object, length_max: int = 40) -> str:
    """Return VALUE as a short, printable part of a sentence, whatever it is."""
    if isinstance(value, str):
        return f"'{printable(value[:length_max])}{'…' if len(value) > length_max else ''}'"
    if isinstance(value, list):
        return "a list"
    if isinstance(value, dict):
        return "a map"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, int):
        return str(value) if INT_MIN <= value < 2**64 else "a huge number"
    return f"{value:g}" if isinstance(value, float) else f"of the type {type(value).__name__}"

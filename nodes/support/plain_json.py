"""JSON of files and nodes, with numbers that arithmetic can take and texts that can be written.

Python's ``json`` also reads NaN, numbers that become infinite, whole numbers that no float can hold, and half
of a surrogate pair; the latter two raise OverflowError and UnicodeEncodeError wherever they are used.
"""

import json
import math
from collections.abc import Callable
from typing import Any, Final

_INT_END: Final = 2**64

Pairs = list[tuple[str, Any]]


def read_json(text: str | bytes, make_object: Callable[[Pairs], dict[str, Any]] = dict) -> Any:
    """Return what TEXT says, with objects made by MAKE_OBJECT.

    Raises ValueError for what is no JSON, is nested too deeply, has a number that is not finite or a whole
    number beyond 64 bits, or a text with half of a surrogate pair.
    """
    try:
        found = json.loads(
            text,
            object_pairs_hook=make_object,
            parse_int=_read_int,
            parse_float=_read_float,
            parse_constant=_refuse_constant,
        )
        json.dumps(found, ensure_ascii=False).encode()
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    except UnicodeEncodeError:
        raise ValueError("a text in it has half of a surrogate pair") from None
    return found


def _read_int(digits: str) -> int:
    value = int(digits)
    if not -_INT_END < value < _INT_END:
        raise ValueError(f"the number {digits[:20]}... has more than 64 bits")
    return value


def _read_float(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise ValueError(f"the number {digits[:20]} is too large")
    return value


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is not a number")

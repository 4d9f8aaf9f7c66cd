"""Decode messages that clients send; reject what is too large, too deep, or not portable.

The bytes of a message are bounded before it comes here, and with them the time: 262,144 bytes of JSON take at
most 15 ms (of numbers; text takes 0.2 ms). msgpack, whose lists take one byte, stops at the limit of values.
"""

import json
import math
from typing import Any, Final

import msgpack

from coordinator.ipc.protocol.limits import EndReason, Limits

_SCALARS: Final = (int, bool, type(None))


class RejectedError(ValueError):
    """A message that ends the connection; END says why."""

    def __init__(self, code: str, sentence: str) -> None:
        super().__init__(sentence)
        self.end = EndReason(code, sentence)


def decode_json(body: bytes, limits: Limits) -> Any:
    """Return the value that BODY holds, whatever JSON can write of it; raises RejectedError."""
    try:
        return json.loads(body.decode(), parse_constant=_reject_constant)
    except RejectedError:
        raise
    except RecursionError:
        raise _too_deep(limits) from None
    except UnicodeDecodeError:
        raise _bad_text() from None
    except json.JSONDecodeError as error:
        sentence = f"a message is not valid JSON: {error.msg}, at character {error.pos + 1}"
        raise RejectedError("bad_message", sentence) from None
    except ValueError:  # of int()
        raise RejectedError("bad_message", "a whole number has too many digits") from None


def decode_msgpack(body: bytes, limits: Limits, *, checked: bool = True) -> Any:
    """Return the value that BODY holds; raises RejectedError.

    CHECKED: also when it has more lists and maps than LIMITS allow values.
    """
    count = _ContainerCount(limits).add if checked else None
    try:
        return msgpack.unpackb(
            body,
            max_array_len=limits.items,
            max_map_len=limits.items,
            max_ext_len=0,
            list_hook=count,
            object_hook=count,
        )
    except RejectedError:
        raise
    except msgpack.StackError:
        raise _too_deep(limits) from None
    except UnicodeDecodeError:
        raise _bad_text() from None
    except (ValueError, msgpack.UnpackException):
        sentence = f"a message is not valid msgpack, or has lists of more than {limits.items:,} items"
        raise RejectedError("bad_message", sentence) from None


def check_values(value: Any, limits: Limits) -> None:
    """Raise RejectedError when VALUE exceeds LIMITS, or holds what not every language can carry."""
    _Inspection(limits).check(value, limits.nesting)


class _ContainerCount:
    """Count lists and maps while msgpack makes them."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._left = limits.values

    def add(self, container: Any) -> Any:
        """Return CONTAINER; raises RejectedError when it is one too many."""
        self._left -= 1
        if self._left < -1:  # the message itself does not count
            raise _too_many(self._limits)
        return container


class _Inspection:
    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._values_left = limits.values

    def check(self, value: Any, depth: int) -> None:
        """Check VALUE, which may have DEPTH lists and maps inside one another."""
        kind = type(value)
        if kind is dict or kind is list:
            self._check_container(value, depth)
        elif kind is str:
            _check_text(value)
        elif kind is float:
            if not math.isfinite(value):
                raise RejectedError("bad_message", "a number is not finite")
        elif kind not in _SCALARS:
            sentence = "a message holds what JSON has no type for; text is a string, not bytes"
            raise RejectedError("bad_message", sentence)

    def _check_container(self, value: Any, depth: int) -> None:
        limits = self._limits
        if depth == 0:
            raise _too_deep(limits)
        if len(value) > limits.items:
            raise RejectedError("too_long", f"a list or map has more than {limits.items:,} items")
        self._values_left -= len(value)
        if self._values_left < 0:
            raise _too_many(limits)
        if type(value) is dict:
            for key in value:
                if type(key) is not str:
                    raise RejectedError("bad_message", "the keys of maps must be strings")
                _check_text(key)
            value = value.values()
        for item in value:
            if type(item) not in _SCALARS:
                self.check(item, depth - 1)


def _check_text(text: str) -> None:
    """Reject half of a surrogate pair, which JSON can write and UTF-8 cannot."""
    try:
        text.isascii() or text.encode()
    except UnicodeEncodeError:
        raise RejectedError("bad_message", "a string is not valid Unicode") from None


def _reject_constant(word: str) -> None:
    """Reject NaN, Infinity and -Infinity."""
    raise RejectedError("bad_message", f"{word} is not a JSON number; numbers are finite")


def _bad_text() -> RejectedError:
    return RejectedError("bad_message", "a message has text that is not UTF-8")


def _too_many(limits: Limits) -> RejectedError:
    return RejectedError(
        "too_long", f"the lists and maps of a message have more than {limits.values:,} items"
    )


def _too_deep(limits: Limits) -> RejectedError:
    return RejectedError("too_deep", f"a message is nested more than {limits.nesting} deep")

"""Requests that an emergency stop of the same client has overtaken.

A stop does not wait for what its client has asked for before. What would undo it, a restart, must not follow
it only because the stop was faster: it was meant to come first.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final

_overtaken: Final = ContextVar("overtaken", default=False)


@contextmanager
def doing(*, overtaken: bool) -> Iterator[None]:
    """Do a request in the block, and the tasks that begin in it; OVERTAKEN: by a stop."""
    token = _overtaken.set(overtaken)
    try:
        yield
    finally:
        _overtaken.reset(token)


def is_overtaken() -> bool:
    """Return whether the request that is being done was overtaken by a stop."""
    return _overtaken.get()

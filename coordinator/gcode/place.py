"""A position as macros see it."""

from typing import NamedTuple


class Place(NamedTuple):
    """A position by its letters, mm."""

    x: float
    y: float
    z: float
    e: float

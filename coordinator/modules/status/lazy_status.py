"""A status whose values are found out when they are asked for."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any


class LazyStatus(Mapping[str, Any]):
    """The results of VALUES, by name."""

    def __init__(self, **values: Callable[[], object]) -> None:
        self._values = values

    def __getitem__(self, name: str) -> object:
        return self._values[name]()

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

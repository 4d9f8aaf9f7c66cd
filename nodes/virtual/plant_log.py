"""Reads the log of a process's plant: heaters, fans, switches, faults and temperatures over time.

Each line has, separated by tabs: true time (CLOCK_MONOTONIC in ns), kind, name, value. Kinds: ``power`` (W,
at each change of a heater), ``fan`` (duty), ``switch`` (1: pressed), ``lost`` (a stepper's first lost step),
``fault`` (its number), ``body`` (°C, every 50 ms).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from nodes.support.errors import CanductorError


@dataclass(frozen=True, slots=True)
class PlantEvent:
    """One line of the log."""

    at_ns: int
    kind: str
    name: str
    value: float


def plant_log(folder: Path, node: str) -> Iterator[PlantEvent]:
    """Yield the events in the log of NODE, oldest first; a line that is still being written is left out.

    FOLDER contains the node's description. Raises CanductorError.
    """
    path = folder / f"{node}.plantlog"
    try:
        with path.open() as file:
            for number, line in enumerate(file, 1):
                if not line.endswith("\n"):
                    return
                yield _event(path, number, line)
    except OSError as error:
        raise CanductorError(f"{path}: the plant's log cannot be read: {error.strerror}") from None


def _event(path: Path, number: int, line: str) -> PlantEvent:
    try:
        at_ns, kind, name, value = line.split("\t")
        return PlantEvent(int(at_ns), kind, name, float(value))
    except ValueError:
        raise CanductorError(f"{path}:{number}: not a line of a plant's log") from None

"""Reads the page of a running plant, which is the truth about it, and switches faults in it.

The layout is that of firmware/plant/plant_page.h.
"""

import mmap
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from nodes.support.errors import CanductorError

_MAGIC: Final = 0x31544E4C50444E43
_NAME: Final = 64
_ITEMS: Final = 80
_STEPPERS: Final = 16
_HISTORY: Final = 4096
_HEADER: Final = np.dtype(
    [("magic", "u8"), ("steppers", "u4"), ("items", "u4"), ("horizon_ns", "u8"), ("updated_ns", "u8")]
)
_ITEM: Final = np.dtype(
    [("name", f"S{_NAME}"), ("kind", "u4"), ("fault", "u4"), ("value", "f8"), ("extra", "f8")]
)
_STEP: Final = np.dtype([("ns", "u8"), ("count", "i8")])
_STEPPER: Final = np.dtype(
    [
        *(("name", f"S{_NAME}"), ("head", "u8"), ("count", "i8"), ("lost", "u8"), ("reserved", "u8")),
        ("history", _STEP, (_HISTORY,)),
    ]
)
_PAGE: Final = np.dtype(
    [("head", _HEADER), ("items", _ITEM, (_ITEMS,)), ("steppers", _STEPPER, (_STEPPERS,))]
)


class PlantItemKind(IntEnum):
    """What an item of a plant is."""

    BODY = 1
    HEATER = 2
    FAN = 3
    SENSOR = 4
    SWITCH = 5
    TMC = 6
    """A stepper's driver."""


class PlantFault(IntEnum):
    """What may be wrong with an item."""

    SOUND = 0
    OPEN = 1
    """A sensor's wire is broken, or that of a driver's UART."""
    SHORTED = 2
    """A sensor's wires touch, or those of a motor: its driver switched off."""
    FALLEN = 3
    """A sensor fell out of its body: it gets as warm as the surroundings, as fast as its lag lets it."""
    STUCK_ON = 4
    """A heater that is on whatever its pin says."""
    DEAD = 5
    """A heater or a fan that does nothing, a driver without supply: with that back it has forgotten all."""
    NEVER = 6
    """A switch that never closes."""
    ALWAYS = 7
    """A switch that is always closed."""
    GARBLED = 8
    """A driver whose answers are damaged on the way."""
    WARM = 9
    """A driver that gives warning."""
    OVERHEATED = 10
    """A driver that switched off."""


_FAULTS: Final[Mapping[PlantItemKind, tuple[PlantFault, ...]]] = {
    PlantItemKind.BODY: (),
    PlantItemKind.HEATER: (PlantFault.STUCK_ON, PlantFault.DEAD),
    PlantItemKind.FAN: (PlantFault.DEAD,),
    PlantItemKind.SENSOR: (PlantFault.OPEN, PlantFault.SHORTED, PlantFault.FALLEN),
    PlantItemKind.SWITCH: (PlantFault.NEVER, PlantFault.ALWAYS),
    PlantItemKind.TMC: (
        PlantFault.OPEN,
        PlantFault.SHORTED,
        PlantFault.DEAD,
        PlantFault.GARBLED,
        PlantFault.WARM,
        PlantFault.OVERHEATED,
    ),
}


@dataclass(frozen=True, slots=True)
class Motor:
    """Where a stepper truly is."""

    count: int
    steps: int
    """Made in all."""
    lost: int
    """Steps that moved nothing: the driver was off, or the axis stood against its stop."""


@dataclass(frozen=True, slots=True)
class Item:
    """A part of the plant as it was last worked out."""

    kind: PlantItemKind
    fault: PlantFault
    value: float
    """Of a body °C; of a heater or fan its duty, 0 to 1; of a sensor its own °C; of a switch 1: pressed; of
    a driver the true time (ns) until which its DIAG is high if no step follows."""
    extra: float
    """Of a heater J given in all; of a fan turns; of a sensor its last sample; of a switch its changes;
    of a driver its SG_RESULT."""


class PlantPage:
    """The page in BUFFER (of a simulated board), or with `at` that of a process. NAME is for messages.

    It is a view: each reading is of the moment. A process works its plant out every 50 ms, or when its
    firmware looks; a simulated board's has to be updated.
    """

    def __init__(self, name: str, buffer: Any) -> None:
        self._name = name
        self._page = np.frombuffer(buffer, _PAGE, 1)
        if int(self._head["magic"]) != _MAGIC:
            raise CanductorError(
                f"{name}: this is no page of a running plant; was its node started with one?"
            )

    @classmethod
    def at(cls, folder: Path, node: str) -> Self:
        """Open the page of NODE, whose description lies in FOLDER; raises CanductorError."""
        path = folder / f"{node}.page"
        try:
            with path.open("r+b") as file:
                return cls(str(path), mmap.mmap(file.fileno(), _PAGE.itemsize))
        except (OSError, ValueError) as error:
            raise CanductorError(f"{path}: the plant's page cannot be opened: {error}") from None

    @property
    def _head(self) -> Any:
        return self._page["head"][0]

    @property
    def updated_ns(self) -> int:
        """True time (of a process: CLOCK_MONOTONIC) at which the items were worked out."""
        return int(self._head["updated_ns"])

    @property
    def motors(self) -> dict[str, Motor]:
        """All steppers by name."""
        rows = self._page["steppers"][0, : int(self._head["steppers"])]
        return {
            row["name"].decode(): Motor(int(row["count"]), int(row["head"]), int(row["lost"])) for row in rows
        }

    def item(self, kind: PlantItemKind, name: str) -> Item:
        """Return the item of KIND called NAME; raises CanductorError."""
        row = self._row(kind, name)
        return Item(kind, PlantFault(int(row["fault"])), float(row["value"]), float(row["extra"]))

    def temperature(self, body: str) -> float:
        """Return how warm BODY truly is, °C."""
        return self.item(PlantItemKind.BODY, body).value

    def names(self, kind: PlantItemKind) -> tuple[str, ...]:
        """Return the names of all items of KIND."""
        return tuple(row["name"].decode() for row in self._rows() if row["kind"] == kind)

    def set_fault(self, kind: PlantItemKind, name: str, fault: PlantFault) -> None:
        """Let FAULT be so from now on; SOUND repairs. Raises CanductorError for what cannot be.

        The plant takes it to heart when it is worked out next.
        """
        row = self._row(kind, name)
        if fault is not PlantFault.SOUND and fault not in _FAULTS[kind]:
            able = ", ".join(other.name.lower() for other in _FAULTS[kind]) or "nothing"
            raise CanductorError(
                f"{self._name}: a {kind.name.lower()} cannot be {fault.name.lower()}; it can be {able}"
            )
        row["fault"] = fault

    def _rows(self) -> Any:
        return self._page["items"][0, : int(self._head["items"])]

    def _row(self, kind: PlantItemKind, name: str) -> Any:
        for row in self._rows():
            if row["kind"] == kind and row["name"] == name.encode():
                return row
        known = ", ".join(self.names(kind)) or "none"
        raise CanductorError(f"{self._name}: there is no {kind.name.lower()} {name!r}; there is {known}")

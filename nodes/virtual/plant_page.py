"""Reads the page of a running plant, which contains its true state, and sets faults in it.

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
_ITEMS: Final = 96
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
    """Kind of an item of a plant."""

    BODY = 1
    HEATER = 2
    FAN = 3
    SENSOR = 4
    SWITCH = 5
    TMC = 6
    """A stepper's driver."""
    COIL = 7
    """The coil of an eddy current probe, with its chip."""
    LOAD_CELL = 8
    """A load cell that carries the nozzle, with its chip."""


class PlantFault(IntEnum):
    """Fault of an item."""

    SOUND = 0
    OPEN = 1
    """The wire of a sensor, or of a driver's UART, is broken."""
    SHORTED = 2
    """The wires of a sensor, or of a motor (its driver switched off), are shorted."""
    FALLEN = 3
    """A sensor fell out of its body: it takes ambient temperature, with its lag."""
    STUCK_ON = 4
    """A heater that is on whatever the level of its pin."""
    DEAD = 5
    """A heater or fan without function; a driver without supply, which loses its registers."""
    NEVER = 6
    """A switch that never closes."""
    ALWAYS = 7
    """A switch that is always closed."""
    GARBLED = 8
    """A driver whose answers arrive damaged; a load cell's chip that misses a pulse of each reading."""
    WARM = 9
    """A driver that reports its overtemperature warning."""
    OVERHEATED = 10
    """A driver that switched off because of its temperature."""
    STUCK = 11
    """A switch that stays as it is; of a BLTouch the pin does."""
    LATE = 12
    """A switch that closes 0.2 mm late."""


_FAULTS: Final[Mapping[PlantItemKind, tuple[PlantFault, ...]]] = {
    PlantItemKind.BODY: (),
    PlantItemKind.HEATER: (PlantFault.STUCK_ON, PlantFault.DEAD),
    PlantItemKind.FAN: (PlantFault.DEAD,),
    PlantItemKind.SENSOR: (PlantFault.OPEN, PlantFault.SHORTED, PlantFault.FALLEN),
    PlantItemKind.SWITCH: (PlantFault.NEVER, PlantFault.ALWAYS, PlantFault.STUCK, PlantFault.LATE),
    PlantItemKind.TMC: (
        PlantFault.OPEN,
        PlantFault.SHORTED,
        PlantFault.DEAD,
        PlantFault.GARBLED,
        PlantFault.WARM,
        PlantFault.OVERHEATED,
    ),
    PlantItemKind.COIL: (PlantFault.OPEN, PlantFault.DEAD, PlantFault.SHORTED),
    PlantItemKind.LOAD_CELL: (
        PlantFault.OPEN,
        PlantFault.DEAD,
        PlantFault.SHORTED,
        PlantFault.NEVER,
        PlantFault.GARBLED,
    ),
}


@dataclass(frozen=True, slots=True)
class Motor:
    """True position of a stepper."""

    count: int
    steps: int
    """Number of all steps."""
    lost: int
    """Steps without movement: the driver was off, or the axis was at its limit."""


@dataclass(frozen=True, slots=True)
class Item:
    """A part of the plant as last computed."""

    kind: PlantItemKind
    fault: PlantFault
    value: float
    """Body: °C; heater, fan: duty, 0 to 1; sensor: its own °C; switch: 1: pressed; driver: true time (ns)
    until which its DIAG is high if no step follows; coil: Hz of its last reading; load cell: g of its
    last reading."""
    extra: float
    """Heater: J delivered so far; fan: revolutions; sensor: last sample; switch: number of changes; driver:
    SG_RESULT."""


class PlantPage:
    """The page in BUFFER (of a simulated board), or with `at` that of a process. NAME is for messages.

    It is a view: each access reads the present state. A process computes its plant every 50 ms and when its
    firmware reads a pin; the plant of a simulated board has to be updated.
    """

    def __init__(self, name: str, buffer: Any) -> None:
        self._name = name
        self._page = np.frombuffer(buffer, _PAGE, 1)
        if int(self._head["magic"]) != _MAGIC:
            raise CanductorError(f"{name}: not the page of a running plant; was its node started with one?")

    @classmethod
    def at(cls, folder: Path, node: str) -> Self:
        """Open the page of NODE, whose description is in FOLDER; raises CanductorError."""
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
        """True time (of a process: CLOCK_MONOTONIC) at which the items were computed."""
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
        """Return the true temperature of BODY, °C."""
        return self.item(PlantItemKind.BODY, body).value

    def names(self, kind: PlantItemKind) -> tuple[str, ...]:
        """Return the names of all items of KIND."""
        return tuple(row["name"].decode() for row in self._rows() if row["kind"] == kind)

    def set_fault(self, kind: PlantItemKind, name: str, fault: PlantFault) -> None:
        """Set a fault, or SOUND to repair it; raises CanductorError for a fault that the kind cannot have.

        It takes effect when the plant is computed next.
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

"""What the demo prints on: virtual nodes in processes of their own, or simulated boards in virtual time."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from coordinator.config.model import MachineDescription
from nodes.virtual.edge_log import Clocks, Directions
from nodes.virtual.plant import Axis
from nodes.virtual.plant_log import PlantEvent
from nodes.virtual.plant_page import Motor


class NodeLog(Protocol):
    """What one node's pins did, with the node's true clock; see nodes.virtual.edge_log.EdgeLog."""

    clock_freq: float
    """Nominal ticks per second."""
    ticks_per_second: float
    """True ticks per second of the host's clock."""
    start_monotonic_ns: int
    start_clock: int

    @property
    def record_count(self) -> int:
        """Changes of level of all pins."""
        ...

    def ticks_to_monotonic_ns(self, clock: Clocks, /) -> npt.NDArray[np.int64]:
        """Return the times of the host's clock at which the node's stood at these."""
        ...

    def edges(self, *pins: int) -> Iterator[tuple[Clocks, npt.NDArray[np.uint16], npt.NDArray[np.uint8]]]:
        """Yield the changes of PINS, oldest first: chunks of clock, pin and level."""
        ...

    def steps(
        self, step_pin: int, dir_pin: int, both_edges: bool, *, step_idle_level: int = 0
    ) -> Iterator[tuple[Clocks, Directions]]:
        """Yield the steps of one stepper: chunks of clock and direction."""
        ...


class Hardware(Protocol):
    """Virtual hardware, which keeps logs that none of the code under test can reach."""

    @property
    def description(self) -> MachineDescription:
        """The machine, with connections to this hardware."""
        ...

    @property
    def axes(self) -> Mapping[str, Axis]:
        """What moves, by the names of axes or of their first steppers."""
        ...

    def motors(self) -> Mapping[str, Mapping[str, Motor]]:
        """Return where every stepper truly is, by node and name."""
        ...

    def edge_log(self, node: str) -> NodeLog:
        """Return NODE's log of pin levels."""
        ...

    def plant_log(self, node: str) -> Iterable[PlantEvent]:
        """Return how warm the bodies around NODE were."""
        ...

    def frames(self) -> tuple[int, int]:
        """Return how many frames were sent on all buses, and how many of them were lost."""
        ...

    def stop_nodes(self) -> Mapping[str, Mapping[str, Any]]:
        """End the nodes, so that their logs are complete; return their statistics."""
        ...

"""Which axle of MT is which: every stepper of a rail has two, one for each direction of travel.

Stepper k (from 1, in the order of the machine's rails) has the axles 2k - 1 for forward and 2k for reverse.
"""

from dataclasses import dataclass
from typing import Final

from coordinator.config.model import MachineDescription
from coordinator.tables.axis_table import Direction
from nodes.devices.stepper import Stepper
from nodes.mt.mt import AXLES
from nodes.mt.table import CONSTANT, AxleTable
from nodes.node.config import NodeConfig

STEPPERS_MAX: Final = len(AXLES) // 2


@dataclass(frozen=True, slots=True)
class StepperTables:
    """The two tables of one stepper."""

    axis: str
    """Of its rail."""
    stepper: str
    node: str
    sides: dict[Direction, AxleTable]

    def configure(self, config: NodeConfig) -> None:
        """Add them to the node's CONFIG, unless its firmware keeps no tables: the coordinator does."""
        if config.dictionary.int_constant(CONSTANT, 0) >= max(side.axle for side in self.sides.values()):
            for side in self.sides.values():
                side.configure(config)

    @property
    def on_node(self) -> bool:
        """Whether the node keeps them; known when its configuration was built."""
        return all(side.oid is not None for side in self.sides.values())


def stepper_tables(description: MachineDescription, steppers: dict[str, Stepper]) -> list[StepperTables]:
    """Return the tables of the machine's STEPPERS: none without [axis_tables], nor beyond MT's reach."""
    if description.axis_tables is None:
        return []
    points = description.axis_tables.points
    named = [(rail.axis, described) for rail in description.rails for described in rail.steppers]
    return [
        StepperTables(
            axis,
            described.name,
            described.node,
            {
                side: AxleTable(f"{described.name} {side}", axle, points, steppers[described.name])
                for side, axle in ((Direction.FORWARD, 2 * k - 1), (Direction.REVERSE, 2 * k))
            },
        )
        for k, (axis, described) in enumerate(named[:STEPPERS_MAX], 1)
    ]

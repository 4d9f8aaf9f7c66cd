"""Switches that motors of a simulated machine press: each closes at a step that is known."""

from collections.abc import Sequence
from dataclasses import dataclass

from coordinator.simulate.stage import Stage
from nodes.virtual.plant import Axis, NodePlant, Stepper, Switch, Term
from nodes.virtual.sim_plant import SimPlant, connect_plants

MOTORS = "mcu"
"""The node of the motors."""


@dataclass(frozen=True)
class MotorSwitch:
    """A switch on PIN of NODE: high while the motor on these pins is at or beyond AT (steps) in DIRECTION."""

    step_pin: str
    dir_pin: str
    node: str
    pin: str
    at: int
    direction: int


def place_switches(stage: Stage, switches: Sequence[MotorSwitch]) -> dict[str, SimPlant]:
    """Connect SWITCHES and their motors; return the plants by node."""
    motors = tuple(
        Stepper(name=switch.step_pin, step_pin=switch.step_pin, dir_pin=switch.dir_pin) for switch in switches
    )
    plants = {}
    for node in dict.fromkeys((MOTORS, *(switch.node for switch in switches))):
        mine = [switch for switch in switches if switch.node == node]
        description = NodePlant(
            node=node,
            steppers=motors if node == MOTORS else (),
            axes=tuple(Axis(name=one.pin, terms=(Term(MOTORS, one.step_pin, 1.0),)) for one in mine),
            switches=tuple(
                Switch(name=one.pin, pin=one.pin, axis=one.pin, at=one.at, direction=one.direction)
                for one in mine
            ),
        )
        plants[node] = stage._boards[node].node.start_plant(description)
    connect_plants(plants)
    return plants

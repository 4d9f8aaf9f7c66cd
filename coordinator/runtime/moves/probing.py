"""One probing move: the head is lowered from rest until the probe triggers, and it is known where that was.

The place follows from the nodes' step counts and from the moment at which the probe's node saw it trigger, so
how far the head went on afterwards does not matter.
"""

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from coordinator.config.model import MachineDescription, ProbeDescription
from coordinator.gcode.commands import Position
from coordinator.kinematics.base import Point
from coordinator.runtime.machine import Machine
from coordinator.runtime.moves.homing import (
    AlreadyPressedError,
    EndstopNotFoundError,
    HomingError,
    HomingMove,
)
from nodes.support.errors import CanductorError

STRAIGHT_DOWN: Final = ("delta",)
"""Kinematics whose motors are no sums of axes, but go along with Z by as much."""
SHORTEST_MM: Final = 1e-3
"""Of a way down: less is none."""


@dataclass(frozen=True, slots=True)
class Contact:
    """A probing move that found something."""

    position: Position
    """Where the machine stands now, by its steps; X Y Z E, mm."""
    trigger_z: float
    """Z of the nozzle when the probe triggered, mm."""

    @property
    def trigger(self) -> Point:
        """X, Y and Z of the nozzle at the trigger."""
        return (self.position[0], self.position[1], self.trigger_z)


def downwards(described: MachineDescription) -> Mapping[str, float] | None:
    """Return how far each motor goes per mm that the head is lowered; None: that depends on the place."""
    straight = described.kinematics.name in STRAIGHT_DOWN
    ways = {}
    for motor in described.motors:
        if not motor.function.linear and not straight:
            return None
        way = motor.weights[2] if motor.function.linear else 1.0
        if way:
            ways[motor.name] = -way
    return ways or None


class ProbingMove:
    """Lowers the head of MACHINE from POSITION (X Y Z E, by the program) until the probe triggers.

    It goes no lower than LOWEST_Z (mm); SPEED in mm/s. SAY shows a sentence to the user.
    """

    def __init__(
        self,
        machine: Machine,
        position: Position,
        *,
        lowest_z: float,
        speed: float,
        say: Callable[[str], None],
    ) -> None:
        probe = machine.description.probe
        ways = downwards(machine.description)
        assert probe is not None
        assert ways is not None
        self._machine, self._probe, self._ways = machine, probe, ways
        self._position, self._lowest_z = position, lowest_z
        self._say = say
        limits = machine.description.limits
        self._speed = min(speed, limits.max_z_velocity)
        self._accel = min(limits.max_accel, limits.max_z_accel)

    async def run(self) -> Contact:
        """Move; raises CanductorError, with all stopped, saying which Z was reached."""
        begin = await self._place()
        way_mm = begin[2] - self._lowest_z
        if way_mm < SHORTEST_MM:
            raise HomingError(
                f"the probe cannot be lowered: Z is {begin[2]:.3f}, and position_min of Z is"
                f" {self._lowest_z:g} mm; move up first"
            )
        move = HomingMove(
            self._machine,
            [self._probe.rail],
            ways=self._ways,
            way_mm=way_mm,
            speed=self._speed,
            accel=self._accel,
        )
        try:
            (result,) = await move.run()
        except (CanductorError, asyncio.CancelledError) as error:
            lowest_z = begin[2] - move.planned_way_mm
            if self._machine.stopped is not None:
                self._say(
                    f"the machine stopped while the probe was lowered: Z is {lowest_z:.3f} mm or higher"
                )
            if self._machine.stopped is not None or isinstance(error, asyncio.CancelledError):
                raise
            reached = await self._reached() or f"{lowest_z:.3f} mm or higher"
            raise HomingError(f"{in_words_of_the_probe(error)}; Z is {reached}") from error
        end = await self._place()
        return Contact((*end, self._position[3]), begin[2] - result.way_to_trigger_mm)

    async def _place(self) -> Point:
        """Return where the head is by the step counts; with axis tables, as the program has it."""
        x, y, z, _ = self._position
        if self._machine.description.axis_tables is not None:
            return (x, y, z)
        return await place_by_steps(self._machine) or (x, y, z)

    async def _reached(self) -> str:
        try:
            place = await place_by_steps(self._machine)
        except CanductorError:
            place = None
        return "" if place is None else f"{place[2]:.3f} mm"


async def place_by_steps(machine: Machine) -> Point | None:
    """Return where the head is by the nodes' step counts; None: no position was declared yet."""
    positions = machine.stepper_positions
    return positions.head(positions.positions(await machine.query_stepper_counts()))


def in_words_of_the_probe(error: CanductorError) -> str:
    """Return what ERROR of a move towards the probe means, without a full stop."""
    if isinstance(error, AlreadyPressedError):
        return (
            "the probe was triggered before the move: lift the head, or check the probe's wiring and whether"
            " its pin has to be inverted"
        )
    if isinstance(error, EndstopNotFoundError):
        return (
            f"the probe did not trigger within {error.way_mm:.3f} mm: check that it is attached and deployed,"
            " and its wiring"
        )
    return str(error)


def check_over_bed(described: MachineDescription, probe: ProbeDescription, x: float, y: float) -> str:
    """Say why the probe is not over the bed with the nozzle at X, Y; empty: it is.

    The bed is taken to be where the nozzle may go.
    """
    space = described.kinematics.work_space
    for letter, at, low, high in zip(
        "XY", (x + probe.offset[0], y + probe.offset[1]), space.low, space.high, strict=False
    ):
        if not low <= at <= high:
            return (
                f"the probe would be at {letter} {at:g}, which is not over the bed ({low:g} to {high:g} mm)"
            )
    return ""

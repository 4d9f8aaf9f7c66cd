"""One probing move: the head is lowered from rest until the probe triggers, and it is known where that was.

The place follows from the nodes' step counts and from the moment at which the probe's node saw it trigger, so
how far the head went on afterwards does not matter.
"""

import asyncio
import math
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
    MoveEndedError,
)
from coordinator.runtime.moves.single import Ramp, SingleMove
from nodes.support.errors import CanductorError

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
    even = described.kinematics.even_along_z
    ways = {}
    for motor in described.motors:
        function = motor.function
        if not function.linear and "z" in function.axes and not even:
            return None
        way = motor.weights[2] if function.linear else float("z" in function.axes)
        if way:
            ways[motor.name] = -way
    return ways or None


class ProbingMove:
    """Lowers the head of MACHINE from POSITION (X Y Z E, by the program) until the probe triggers.

    It goes no lower than LOWEST_Z (mm); SPEED in mm/s. CORRECTED: the program's X Y Z are not those of the
    motors, so that POSITION counts and not the motors' own. ACCEL: of the move at most, mm/s²; None: that of
    the machine. SAY shows a sentence to the user.
    """

    def __init__(
        self,
        machine: Machine,
        position: Position,
        *,
        lowest_z: float,
        speed: float,
        corrected: bool,
        accel: float | None = None,
        say: Callable[[str], None],
    ) -> None:
        probe = machine.description.probe
        ways = downwards(machine.description)
        assert probe is not None
        assert ways is not None
        self._machine, self._probe, self._ways = machine, probe, ways
        self._position, self._lowest_z = position, lowest_z
        self._corrected = corrected or machine.description.axis_tables is not None
        self._say = say
        limits = machine.description.limits
        self._speed = min(speed, limits.max_z_velocity)
        most = min(limits.max_accel, limits.max_z_accel)
        self._accel = min(most, accel or most)

    async def run(self) -> Contact:
        """Move; raises CanductorError, with all stopped, saying which Z was reached."""
        begin = await self._place(self._position[:3])
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
        x, y, z = await self._place((begin[0], begin[1], begin[2] - result.way_mm))
        return Contact((x, y, z, self._position[3]), begin[2] - result.way_to_trigger_mm)

    async def _place(self, otherwise: Point) -> Point:
        """Return where the head is by the step counts alone; OTHERWISE where they are not of the program."""
        if self._corrected:
            return otherwise
        return await place_by_steps(self._machine) or otherwise

    async def _reached(self) -> str:
        try:
            place = await place_by_steps(self._machine)
        except CanductorError:
            place = None
        return "" if place is None else f"{place[2]:.3f} mm"


class SlowLift:
    """Lifts the head of MACHINE by WAY_MM at SPEED, from rest, whatever it is in contact with."""

    def __init__(self, machine: Machine, way_mm: float, speed: float) -> None:
        ways = downwards(machine.description)
        assert ways is not None
        limits = machine.description.limits
        self._machine = machine
        self._ways = {name: -way for name, way in ways.items()}
        accel = min(limits.max_accel, limits.max_z_accel)
        self._ramp = Ramp(way_mm, min(speed, limits.max_z_velocity), accel)
        self.begin_s = self.end_s = 0.0
        """Print times; ``run`` sets them."""

    async def run(self) -> float:
        """Move, and return the way that was made by the steps, mm; raises CanductorError."""
        before = await self._machine.query_stepper_counts()
        move = SingleMove(self._machine, self._ramp, ways=self._ways)
        self.begin_s, self.end_s = move.begin_s, move.end_s
        await move.run()
        after = await self._machine.query_stepper_counts()
        ways = [
            (after[motor.name] - before[motor.name]) * motor.step_distance / self._ways[motor.name]
            for motor in self._machine.description.motors
            if motor.name in self._ways
        ]
        return math.fsum(ways) / len(ways)

    def way_at(self, print_time: float) -> float:
        """Return how far up it is at a print time, mm."""
        return self._ramp.way_at(print_time - self.begin_s)


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
    return error.why if isinstance(error, MoveEndedError) else str(error)


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

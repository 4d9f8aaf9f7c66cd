"""A straight move of the head past the program, for homing: where it led to is known by the steps made."""

import math

from coordinator.kinematics.geometry import fit_point
from coordinator.runtime.machine import Machine
from coordinator.runtime.moves.single import Ramp, SingleMove

Way = tuple[float, float, float]
"""X Y Z, mm."""
SHORTEST_MM = 1e-4
"""Less than a step of any machine."""


async def move_by(machine: Machine, way: Way, speed: float, accel: float) -> Way:
    """Move from rest to rest by WAY; return the way that was made. SPEED in mm/s, ACCEL in mm/s².

    The way of each stepper must be a sum of X, Y and Z. Raises CanductorError.
    """
    length = math.dist(way, (0.0, 0.0, 0.0))
    if length < SHORTEST_MM:
        return (0.0, 0.0, 0.0)
    began_at = await machine.query_stepper_counts()
    x, y, z = (value / length for value in way)
    await SingleMove(machine, Ramp(length, speed, accel), (x, y, z, 0.0)).run()
    ended_at = await machine.query_stepper_counts()
    motors = machine.description.motors
    made = [(ended_at[motor.name] - began_at[motor.name]) * motor.step_distance for motor in motors]
    return fit_point([motor.weights[:3] for motor in motors], made)

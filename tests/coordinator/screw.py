"""A virtual machine whose X screw is wrong, measured and then corrected by what was measured.

The screw is a model of its own: it sees only when the motor's steps were executed, and where the program
wanted the axis to be.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coordinator.tables.axis_table import AxisTable
from coordinator.verification.planned import epochs
from tests.coordinator.motion.exact_program import Planned, plan_program
from tests.stages.printer_text import MCU, printer_section, section, stepper_section

Floats = NDArray[np.float64]
MICROSTEPS = 32
STEP_MM = 8 / (200 * MICROSTEPS)
KNOT_MM = 0.5
"""Sixteen points a turn: linear between them, they miss 2 % of a wobble at most; eight miss 8 %."""
TRAVEL_MM = 300


def machine_text(microsteps: int) -> str:
    return (
        MCU
        + printer_section(max_velocity=120, max_accel=2000, max_z_velocity=10)
        + stepper_section(
            "stepper_x",
            "PB0",
            "PB1",
            microsteps=microsteps,
            rotation_distance=8,
            endstop_pin="^PC0",
            position_endstop=0,
            position_max=TRAVEL_MM,
            homing_speed=20,
        )
        + stepper_section("stepper_y", "PB3", "PB4", endstop_pin="^PC1", position_endstop=0, position_max=250)
        + stepper_section(
            "stepper_z",
            "PA0",
            "PA1",
            rotation_distance=8,
            endstop_pin="^PA3",
            position_endstop=0,
            position_max=250,
        )
        + section("input_shaper")
    )


@dataclass(frozen=True)
class Screw:
    """What is wrong with it. Homed towards smaller positions, so the reverse flank is right at 0."""

    stretch: float = 3e-4
    """mm per mm: it is longer than it should be."""
    lead_mm: float = 8.0
    wobble_mm: float = 0.012
    """Once a turn."""
    backlash_mm: float = 0.04

    def actual(self, motor_mm: Floats) -> Floats:
        """Return where the axis is, for a motor that was at MOTOR_MM one after the other, from home on."""
        nut = np.empty_like(motor_mm)
        at = float(motor_mm[0])
        for i, motor in enumerate(motor_mm.tolist()):
            at = min(max(at, motor - self.backlash_mm), motor)
            nut[i] = at
        turned: Floats = 2 * math.pi * nut / self.lead_mm
        return nut * (1 + self.stretch) + self.wobble_mm * np.sin(turned)


PERFECT = Screw(stretch=0, wobble_mm=0, backlash_mm=0)
"""Moved by whole steps that may come 12.5 µs early or late: what is wrong with it, no table takes away."""


@dataclass(frozen=True)
class Trial:
    """A program done by the machine: at TIMES_S the axis should have been at WANTED and was at ACTUAL."""

    plan: Planned
    times_s: Floats
    wanted_mm: Floats
    actual_mm: Floats

    @property
    def errors_mm(self) -> Floats:
        return self.actual_mm - self.wanted_mm

    @property
    def rms_mm(self) -> float:
        return float(np.sqrt(np.mean(self.errors_mm**2)))


def carry_out(
    lines: list[str],
    screw: Screw,
    folder: Path,
    tables: Mapping[str, AxisTable],
    every_s: float = 5e-4,
    *,
    microsteps: int = MICROSTEPS,
) -> Trial:
    """Plan LINES, replay what the node executes, and let SCREW turn it into true positions."""
    config, program = folder / "screw.cfg", folder / "screw.gcode"
    config.write_text(machine_text(microsteps))
    program.write_text("\n".join(["G28", *lines, ""]))
    plan = plan_program(config, program, tables)
    moves = np.concatenate([moves for _, moves in epochs(plan.record)])
    begin = float(moves["print_time"][0])
    times = np.arange(begin, plan.print_time_s, every_s)
    motor = motor_mm(plan, "stepper_x", times)
    return Trial(plan, times, planned_mm(moves, times), screw.actual(motor))


def motor_mm(plan: Planned, name: str, times_s: Floats) -> Floats:
    """Return where a motor stood, by the steps its node had executed."""
    spec = next(spec for spec in plan.steppers if spec.name == name)
    clock, direction, before = plan.streams()[name].expand()
    positions = np.concatenate(([0], before + direction))
    done = np.searchsorted(clock / plan.nodes[spec.node].clock_freq, times_s, side="right")
    return np.asarray(positions[done] * spec.step_distance)


def planned_mm(moves: NDArray[np.void], times_s: Floats, axis: int = 0) -> Floats:
    """Return where an axis was wanted, straight from the definition of a trapezoid."""
    at = np.clip(np.searchsorted(moves["print_time"], times_s, side="right") - 1, 0, None)
    m = moves[at]
    t = np.maximum(times_s - m["print_time"], 0)
    t1 = np.clip(t, 0, m["accel_s"])
    t2 = np.clip(t - m["accel_s"], 0, m["cruise_s"])
    t3 = np.clip(t - m["accel_s"] - m["cruise_s"], 0, m["decel_s"])
    way = m["start_v"] * t1 + m["accel"] * (t1 * t1 - t3 * t3) / 2 + m["cruise_v"] * (t2 + t3)
    return np.asarray(m["start"][:, axis] + m["ratio"][:, axis] * way)


def measure(
    screw: Screw, folder: Path, *, knot_mm: float = KNOT_MM, microsteps: int = MICROSTEPS
) -> AxisTable:
    """Stop at every point of the table in both directions, and read where the axis really is."""
    knots = [knot_mm * k for k in range(1, round(TRAVEL_MM / knot_mm))]
    forth = [f"G1 X{x:g} F3000\nG4 P20" for x in knots]
    back = [f"G1 X{x:g} F3000\nG4 P20" for x in reversed(knots)]
    trial = carry_out(["G1 X0.2 F3000", *forth, "G1 X300", *back], screw, folder, {}, microsteps=microsteps)
    stands = np.diff(trial.wanted_mm, prepend=np.nan) == 0
    turned = int(np.argmax(trial.wanted_mm))
    sides = []
    for part in (slice(0, turned), slice(turned, None)):
        wanted, actual = trial.wanted_mm[part][stands[part]], trial.actual_mm[part][stands[part]]
        sides.append([x - float(np.mean(actual[np.abs(wanted - x) < 1e-6])) for x in knots])
    return AxisTable(axis="x", positions=tuple(knots), forward=tuple(sides[0]), reverse=tuple(sides[1]))


def workout(seed: int, moves: int) -> list[str]:
    """Return moves to and fro over all of the travel, on slants, at many speeds."""
    random = np.random.default_rng(seed)
    low, high = (2, 0, 15), (298, 250, 100)
    places = random.uniform(low, high, (moves, 3))
    return [f"G1 X{x:.3f} Y{y:.3f} F{60 * speed:.0f}" for x, y, speed in places]

"""One straight move from standstill, streamed to the nodes by itself: what homing is made of.

It has step generation of its own, which begins with a reset of the steppers' clocks. So it can follow on
anything, and whatever is left of it when the steppers are stopped on their nodes is simply dropped.
"""

import asyncio
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from coordinator.config.model import StepperDescription
from coordinator.motion.moves import Move
from coordinator.motion.specs import StepperSpec
from coordinator.motion.steps.steps import SHORT_S, StepGenerator
from coordinator.runtime.machine import Machine, link_of
from coordinator.runtime.timebase import JumpWatch

START_LEAD_S: Final = 0.4
"""From now to the first step: time to arm what has to stop it, and for the steps to reach the nodes."""
SEND_AHEAD_S: Final = 0.6
"""Steps are made so far ahead of now: a busy host may pause that long, and what is left over is dropped."""
CYCLE_S: Final = 0.05
SETTLE_S: Final = 0.05
"""After the last step is due, before it counts as done."""
BATCH_ROOM: Final = 1 << 16
AXES: Final = ("x", "y", "z")

Ratio = tuple[float, float, float, float]
"""What each of X Y Z E moves per mm of way."""
WAY: Final = (1.0, 0.0, 0.0, 0.0)
"""Where motors have ways of their own."""


@dataclass(frozen=True, slots=True)
class Ramp:
    """Way over time of a move from rest to rest, in mm and s."""

    way_mm: float
    speed: float
    accel: float

    @property
    def top_speed(self) -> float:
        """What is reached: a short way allows less than ``speed``."""
        return min(self.speed, math.sqrt(self.accel * self.way_mm))

    @property
    def ramp_s(self) -> float:
        """How long it accelerates, and brakes."""
        return self.top_speed / self.accel

    @property
    def cruise_s(self) -> float:
        """How long it runs at its top speed."""
        return max(0.0, self.way_mm / self.top_speed - self.ramp_s)

    @property
    def duration_s(self) -> float:
        """All of it."""
        return 2 * self.ramp_s + self.cruise_s

    def way_at(self, t: float) -> float:
        """Return the way T s after the begin."""
        t = min(max(t, 0.0), self.duration_s)
        rest = self.duration_s - t
        if t < self.ramp_s:
            return self.accel * t * t / 2
        if rest < self.ramp_s:
            return self.way_mm - self.accel * rest * rest / 2
        return self.accel * self.ramp_s**2 / 2 + self.top_speed * (t - self.ramp_s)

    def move(self, print_time: float, ratio: Ratio) -> Move:
        """Return it as a move that begins at PRINT_TIME where all axes are 0."""
        return Move(
            print_time=print_time,
            accel_s=self.ramp_s,
            cruise_s=self.cruise_s,
            decel_s=self.ramp_s,
            start_v=0.0,
            cruise_v=self.top_speed,
            accel=self.accel,
            start=(0.0, 0.0, 0.0, 0.0),
            ratio=ratio,
            pressure_advance=0.0,
            line=0,
        )


def ratio_of(axis: str, direction: int) -> Ratio:
    """Return the ratio of a move along one AXIS (x, y or z) in DIRECTION 1 or -1."""
    x, y, z = (float(direction) if axis == name else 0.0 for name in AXES)
    return (x, y, z, 0.0)


class SingleMove:
    """RAMP on MACHINE, beginning LEAD_S from its making: of the axes along RATIO, or of motors.

    WAYS: by stepper how far it goes per mm of way (mm, or rad where it turns something), whatever moves it
    otherwise; those that are not named stand still.
    """

    def __init__(
        self,
        machine: Machine,
        ramp: Ramp,
        ratio: Ratio = WAY,
        *,
        ways: "Mapping[str, float] | None" = None,
        lead_s: float = START_LEAD_S,
    ) -> None:
        self._machine = machine
        self._ways = ways
        self._time_base = machine.time_base()
        self.ramp = ramp
        self._ratio = ratio
        self.steppers: Sequence[StepperDescription] = [
            s for s in machine.description.steppers if self.along(s) != 0
        ]
        """Those it moves."""
        machine.modules.before_motion([stepper.name for stepper in self.steppers])
        now = self.print_time_now()
        self.begin_s = now + lead_s
        self.end_s = self.begin_s + ramp.duration_s
        self._nodes = machine.moving
        specs = machine.devices.stepper_specs()
        if ways is not None:
            specs = [_by_itself(spec, ways.get(spec.name, 0.0)) for spec in specs]
        self._jumps = JumpWatch((machine.primary, *self._nodes))
        self._jumps.look(now, self.end_s)
        self._steps = StepGenerator(specs, machine.stream_specs(), longest_s=SHORT_S)
        self._maps = [machine.clock_map(self._time_base, node, now) for node in self._nodes]
        for index, clock_map in enumerate(self._maps):
            piece = clock_map.last
            self._steps.set_clock_base(index, piece.print_time, round(piece.ticks), piece.ticks_per_s)
        self._steps.append(ramp.move(self.begin_s, ratio).to_bytes(), 1)

    def print_time_now(self) -> float:
        """Return the present print time."""
        return self._time_base.print_time_at(self._machine.host.now())

    def print_time_of(self, node_name: str, ticks: int) -> float:
        """Return the print time at which a node's clock shows TICKS (64 bits)."""
        node = self._machine.nodes[node_name]
        if node is self._machine.primary:
            return ticks / node.clock_freq_hz
        return self._time_base.print_time_at(node.best_clock.ns_at(ticks))  # type: ignore[arg-type]

    def ticks_at(self, node_name: str, print_time: float) -> int:
        """Return a node's clock (64 bits) at a print time."""
        node = self._machine.nodes[node_name]
        return node.best_clock.ticks_at(self._time_base.host_ns_at(print_time))

    async def run(self) -> None:
        """Make the whole move and return when its last step is done; raises CanductorError."""
        while self.print_time_now() < self.end_s + SETTLE_S:
            self.stream()
            await asyncio.sleep(CYCLE_S)
            if self._machine.stopped is not None:
                raise self._machine.stopped.with_traceback(None)

    def stream(self) -> None:
        """Make and send what is due by now; CanductorError when a node cannot take it."""
        now = self.print_time_now()
        self._jumps.look(now, self.end_s)
        until = min(now + SEND_AHEAD_S, self.end_s)
        border = self._steps.generated_until
        for index, (node, clock_map) in enumerate(zip(self._nodes, self._maps, strict=True)):
            if node is not self._machine.primary and border > clock_map.last.print_time:
                piece = self._time_base.steer(node.name, clock_map, node.best_clock, border)
                self._steps.set_clock(index, piece.ticks_per_s)
        done = False
        while not done:
            done = self._steps.generate(max(until, border), flush=until >= self.end_s)
            for index, node in enumerate(self._nodes):
                while batch := self._steps.take_batch(index, BATCH_ROOM):
                    link_of(node).send_batch(batch)
        self._machine.check_load()

    def along(self, stepper: StepperDescription) -> float:
        """Return how many mm a stepper moves per mm of way; 0 where that is not the same all the way."""
        if self._ways is not None:
            return self._ways.get(stepper.name, 0.0)
        return sum(weight * share for weight, share in zip(stepper.weights, self._ratio, strict=True))

    def planned_steps(self, stepper: StepperDescription, way_mm: float) -> float:
        """Return where a stepper is after WAY_MM, in steps from the begin; a step is due at every half."""
        return self.along(stepper) * way_mm / stepper.step_distance


def _by_itself(spec: StepperSpec, way: float) -> StepperSpec:
    return replace(spec, weights=(way, 0.0, 0.0, 0.0), formula=None, params=())

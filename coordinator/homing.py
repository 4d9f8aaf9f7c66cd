"""Homing moves: steppers on any nodes stop when an endstop on any node switches, and it is known where.

When all nodes involved are on one CAN bus and know trigger groups, the endstop's node tells the others
itself, within a frame or two. Otherwise the host relays: it hears the stop group of the endstop's node and
triggers those of the others. In both cases every node stops by itself when it has not heard from the host
for TIMEOUT_S, and the host goes on renewing that only while it hears from all nodes.

What a stepper did after the trigger (its overshoot) is known exactly: the node counts its steps, and the
plan says where it was at the moment at which the endstop was seen to switch.
"""

import asyncio
import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from coordinator.app import Machine
from coordinator.machine.description import CanConnection, RailDescription, StepperDescription
from coordinator.single_move import Ramp, SingleMove, ratio_of
from nodes.clock import Ticks, extend32
from nodes.devices.trsync import NO_GROUP, TriggerReason, Trsync, TrsyncState
from nodes.errors import CanductorError
from nodes.node import Node

CYCLE_S: Final = 0.025
"""How often steps are sent, and time-outs renewed."""
TIMEOUT_S: Final = 0.25
"""A node that hears nothing from the host for so long while it homes with others stops."""
TIMEOUT_ALONE_S: Final = 2.0
"""The same when endstop and steppers are on one node: nothing has to be relayed."""
REPORTS: Final = 10
"""Reports of a stop group within a time-out: several may get lost."""
LATE_S: Final = 0.25
"""After the end of the move, before the endstop counts as not found."""
LOOK_S: Final = 50e-6
"""Between two looks at the endstop: at 50 mm/s less than 3 µm."""
GROUP: Final = 0
"""The trigger group of homing: there is one homing move at a time."""


class HomingError(CanductorError):
    """An axis could not be homed; the sentence says why and what to do."""


@dataclass(frozen=True, slots=True)
class Overshoot:
    """What one stepper did after the trigger."""

    stepper: str
    node: str
    steps: int
    distance_mm: float
    """In the direction of the move."""

    def __str__(self) -> str:
        return f"{self.stepper} on {self.node}: overshoot {self.steps} steps ({self.distance_mm:.4f} mm)"


@dataclass(frozen=True, slots=True)
class HomingResult:
    """A homing move that found its endstop."""

    rail: str
    way_to_trigger_mm: float
    """Along the axis, from the begin to where it was at the trigger."""
    way_mm: float
    """To where it stands now, by the steps that were made."""
    triggered_at_s: float
    """Print time at which the endstop was seen to switch."""
    through_group: bool
    """Whether the nodes stopped each other, past the host."""
    moved: dict[str, int]
    """By stepper: steps made, positive as motion counts."""
    overshoots: tuple[Overshoot, ...]

    @property
    def beyond_trigger_mm(self) -> float:
        """How far the axis stands behind the trigger, in the direction of the move."""
        return self.way_mm - self.way_to_trigger_mm


class HomingMove:
    """One move of RAIL's axis in DIRECTION (1 or -1), at most WAY_MM far, until its endstop switches.

    SPEED in mm/s, ACCEL in mm/s². The machine stands still and its rail has an endstop on a pin.
    """

    def __init__(
        self,
        machine: Machine,
        rail: RailDescription,
        *,
        direction: int,
        way_mm: float,
        speed: float,
        accel: float,
    ) -> None:
        self._machine = machine
        self._rail = rail
        self._direction = direction
        self._ramp = Ramp(way_mm, speed, accel)
        self._endstop = machine.devices.endstops[rail.axis]
        self._endstop_node = machine.nodes[machine.devices.endstop_node(rail)]
        self._triggered = asyncio.Event()
        self._heard_s: dict[str, float] = {}

    async def run(self) -> HomingResult:
        """Move until the endstop switches; raises HomingError with everything stopped."""
        if (await self._endstop.state(self._endstop_node)).pressed:
            raise HomingError(
                f"the endstop of axis {self._rail.axis} is pressed before the move towards it; move the axis "
                "away by hand, or check the endstop's wiring and whether its pin has to be inverted"
            )
        began_at = await self._machine.stepper_positions()
        move = SingleMove(self._machine, self._ramp, ratio_of(self._rail.axis, self._direction))
        syncs = self._syncs(move)
        ends: list[Callable[[], None]] = []
        try:
            ends = [sync.listen(node, self._hear(node, sync, syncs, move)) for node, sync in syncs]
            await self._arm(move, syncs)
            await self._until_trigger(move, syncs)
        finally:
            for end in ends:
                end()
            states = await self._end(syncs)
        self._check(states, syncs)
        return await self._result(move, began_at)

    # ------------------------------------------------------------------------------------------ set up

    def _syncs(self, move: SingleMove) -> list[tuple[Node, Trsync]]:
        names = dict.fromkeys([self._endstop_node.name, *(stepper.node for stepper in move.steppers)])
        return [(self._machine.nodes[name], self._machine.devices.trsyncs[name]) for name in names]

    def _use_group(self, syncs: Sequence[tuple[Node, Trsync]]) -> bool:
        """Whether the nodes can stop each other: all on one bus, all with trigger groups."""
        wires = {
            node.connection.interface if isinstance(node.connection, CanConnection) else node.name
            for node in self._machine.description.nodes
            if node.name in {other.name for other, _ in syncs}
        }
        return len(wires) == 1 and all(sync.groups > GROUP for _, sync in syncs)

    def _timeout_s(self, syncs: Sequence[tuple[Node, Trsync]]) -> float:
        return TIMEOUT_S if len(syncs) > 1 else TIMEOUT_ALONE_S

    async def _arm(self, move: SingleMove, syncs: Sequence[tuple[Node, Trsync]]) -> None:
        timeout_s = self._timeout_s(syncs)
        now = move.print_time_now()
        group = GROUP if len(syncs) > 1 and self._use_group(syncs) else NO_GROUP
        for node, sync in syncs:
            self._heard_s[node.name] = now
            if sync.groups:
                sync.join(node, group)
            sync.start(
                node,
                report_clock=move.ticks_at(node.name, move.begin_s),
                report_ticks=round(timeout_s / REPORTS * node.clock_freq_hz),
                timeout_clock=move.ticks_at(node.name, move.begin_s + timeout_s),
            )
            for stepper in move.steppers:
                if stepper.node == node.name:
                    sync.stop_on_trigger(node, self._stepper_oid(stepper))
            if node is self._endstop_node:
                assert sync.oid is not None
                self._endstop.home(
                    node,
                    clock=move.ticks_at(node.name, move.begin_s),
                    rest_ticks=self._rest_ticks,
                    trsync_oid=sync.oid,
                )
        for node, _ in syncs:
            await node.link.drained()
        if move.print_time_now() > move.begin_s:
            raise HomingError(
                f"axis {self._rail.axis} was not homed: arming its nodes took too long; check the bus for "
                "errors and load"
            )

    def _stepper_oid(self, stepper: StepperDescription) -> int:
        oid = self._machine.devices.steppers[stepper.name].oid
        assert oid is not None
        return oid

    @property
    def _rest_ticks(self) -> int:
        return round(LOOK_S * self._endstop_node.clock_freq_hz)

    # ------------------------------------------------------------------------------------------ under way

    def _hear(
        self, node: Node, sync: Trsync, syncs: Sequence[tuple[Node, Trsync]], move: SingleMove
    ) -> Callable[[TrsyncState], None]:
        """Return what takes the reports of one node's stop group."""

        def heard(state: TrsyncState) -> None:
            self._heard_s[node.name] = move.print_time_now()
            if state.armed or self._triggered.is_set():
                return
            self._triggered.set()
            for other, other_sync in syncs:
                if other_sync is not sync and other.talks:
                    other_sync.trigger_now(other)

        return heard

    async def _until_trigger(self, move: SingleMove, syncs: Sequence[tuple[Node, Trsync]]) -> None:
        timeout_s = self._timeout_s(syncs)
        while not self._triggered.is_set() and move.print_time_now() < move.end_s + LATE_S:
            move.stream()
            # Nobody is to go on longer than the host has heard from all.
            until_s = min(self._heard_s.values()) + timeout_s
            if until_s > move.begin_s + timeout_s:
                for node, sync in syncs:
                    sync.renew(node, move.ticks_at(node.name, until_s))
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(CYCLE_S):
                    await self._triggered.wait()
            if self._machine.stopped is not None:
                raise self._machine.stopped

    async def _end(self, syncs: Sequence[tuple[Node, Trsync]]) -> dict[str, TrsyncState]:
        """Stop what is not stopped yet, drop what is queued; return how every node's round ended."""
        states = {}
        for node, sync in syncs:
            if node.talks:
                sync.trigger_now(node)
        for node, sync in syncs:
            with contextlib.suppress(CanductorError):  # whoever is missing afterwards was lost
                states[node.name] = await sync.finish(node)
        if self._endstop_node.talks:
            self._endstop.end(self._endstop_node)
        return states

    def _check(self, states: dict[str, TrsyncState], syncs: Sequence[tuple[Node, Trsync]]) -> None:
        for node, _ in syncs:
            if node.name not in states:
                raise node.failure or HomingError(f"node {node.name} did not answer while an axis homed")
            if states[node.name].reason is TriggerReason.TIMEOUT:
                raise HomingError(
                    f"axis {self._rail.axis} was not homed: node {node.name} did not hear from the host for "
                    f"{self._timeout_s(syncs):g} s and stopped by itself; check the bus for errors and load"
                )
        if states[self._endstop_node.name].reason is not TriggerReason.ENDSTOP:
            raise HomingError(
                f"axis {self._rail.axis} moved {self._ramp.way_mm:g} mm and its endstop did not switch; "
                "check the endstop's wiring, the direction of the axis, and homing_positive_dir"
            )

    # ------------------------------------------------------------------------------------------ afterwards

    async def _result(self, move: SingleMove, began_at: dict[str, int]) -> HomingResult:
        ended_at = await self._machine.stepper_positions()
        moved = {s.name: ended_at[s.name] - began_at[s.name] for s in move.steppers}
        triggered_at_s = await self._trigger_time(move)
        to_trigger = self._ramp.way_at(triggered_at_s - move.begin_s)
        overshoots = tuple(self._overshoot(move, s, moved[s.name], to_trigger) for s in move.steppers)
        syncs = self._syncs(move)
        return HomingResult(
            rail=self._rail.axis,
            way_to_trigger_mm=to_trigger,
            way_mm=self._way(move, moved),
            triggered_at_s=triggered_at_s,
            through_group=len(syncs) > 1 and self._use_group(syncs),
            moved=moved,
            overshoots=overshoots,
        )

    async def _trigger_time(self, move: SingleMove) -> float:
        """Return the print time of the first of the looks that found the endstop pressed."""
        state = await self._endstop.state(self._endstop_node)
        name = self._endstop_node.name
        near = Ticks(move.ticks_at(name, move.print_time_now()))
        return move.print_time_of(name, extend32(state.next_clock32, near) - self._rest_ticks)

    @staticmethod
    def _overshoot(move: SingleMove, stepper: StepperDescription, moved: int, to_trigger: float) -> Overshoot:
        planned = move.planned_steps(stepper, to_trigger)
        forward = 1 if planned >= 0 else -1
        steps = forward * (moved - int(np.floor(planned + 0.5)))
        distance = forward * (moved - planned) * stepper.step_distance
        return Overshoot(stepper.name, stepper.node, steps, distance / _along(move, stepper))

    @staticmethod
    def _way(move: SingleMove, moved: dict[str, int]) -> float:
        """Return how far along the move the axis is by the steps made: the mean of its steppers'."""
        ways = [moved[s.name] * s.step_distance / float(np.dot(s.weights, move.ratio)) for s in move.steppers]
        return float(np.mean(ways))


def _along(move: SingleMove, stepper: StepperDescription) -> float:
    """Return how many mm a stepper moves per mm of the axis."""
    return abs(float(np.dot(stepper.weights, move.ratio)))

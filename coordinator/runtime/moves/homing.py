"""Homing moves: steppers on any nodes stop when an endstop on any node switches, and it is known where.

When all nodes involved are on one CAN bus and know trigger groups, the endstop's node signals the others
itself, within a frame or two. Otherwise the host relays: it receives the stop group of the endstop's node and
triggers those of the others. In both cases every node stops by itself when it has not heard from the host
for TIMEOUT_S, and the host goes on renewing that only while all nodes answer.

What a stepper did after the trigger (its overshoot) is known exactly: the node counts its steps, and the
plan says where it was at the moment at which the endstop was seen to switch.
"""

import asyncio
import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from coordinator.config.model import CanConnection, RailDescription, StepperDescription
from coordinator.runtime.machine import Machine
from coordinator.runtime.moves.single import START_LEAD_S, WAY, Ramp, SingleMove, ratio_of
from nodes.clock.clock import Ticks, extend32
from nodes.devices.endstop import Endstop, SensorEndstop
from nodes.devices.trsync import NO_GROUP, TriggerReason, Trsync, TrsyncState
from nodes.node.node import Node
from nodes.support.errors import CanductorError

CYCLE_S: Final = 0.025
"""How often steps are sent, and time-outs renewed."""
TIMEOUT_S: Final = 0.25
"""A node that receives nothing from the host for so long while it homes with others stops."""
TIMEOUT_ALONE_S: Final = 2.0
"""The same when endstop and steppers are on one node: nothing has to be relayed."""
REPORTS: Final = 10
"""Reports of a stop group within a time-out: several may get lost."""
LATE_S: Final = 0.25
"""After the end of the move, before the endstop counts as not found."""
OPEN_LOOKS: Final = 4
OPEN_LOOK_S: Final = 0.05
"""An endstop that so many looks, so far apart, see pressed is pressed."""
LOOK_S: Final = 50e-6
"""Between two looks at the endstop: at 50 mm/s less than 3 µm."""


LEADS_S: Final = (START_LEAD_S, 0.8, 1.6)
"""To when the move begins: a busy host, or a bus that repeats much, may need longer to arm all nodes."""


class HomingError(CanductorError):
    """An axis could not be homed; the sentence says why and what to do."""


class AlreadyPressedError(HomingError):
    """The endstop was pressed before the move towards it."""


class EndstopNotFoundError(HomingError):
    """The endstop did not switch on the whole way."""

    def __init__(self, sentence: str, way_mm: float) -> None:
        super().__init__(sentence)
        self.way_mm = way_mm
        """How long that was."""


class MoveEndedError(HomingError):
    """The move was ended before the endstop switched, for a reason that has nothing to do with it."""

    def __init__(self, axes: str, why: str) -> None:
        super().__init__(f"axis {axes} was not homed: {why}")
        self.why = why


class _LateError(MoveEndedError):
    """The nodes were not armed in time; all are stopped again."""


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


@dataclass(eq=False, slots=True)
class _Leg:
    """One rail of a homing move: its endstop and what that stops."""

    rail: RailDescription
    slot: int
    endstop: Endstop | SensorEndstop
    endstop_node: Node
    steppers: Sequence[StepperDescription]
    syncs: Sequence[tuple[Node, Trsync]]
    """One for each node that takes part."""
    by_group: bool
    """Whether the nodes can stop each other: all on one bus, all with trigger groups."""
    triggered: asyncio.Event
    triggered_s: float | None = None
    """Print time at which the host heard of it."""
    unknown: dict[str, CanductorError] = field(default_factory=dict)
    """By node: why it is not known how its round ended."""

    @property
    def name(self) -> str:
        return self.rail.axis

    @property
    def timeout_s(self) -> float:
        return TIMEOUT_S if len(self.syncs) > 1 else TIMEOUT_ALONE_S

    @property
    def rest_ticks(self) -> int:
        return round(LOOK_S * self.endstop_node.clock_freq_hz)


class HomingMove:
    """One move of the head along AXIS (x, y, z) in DIRECTION (1 or -1), or of motors, at most WAY_MM far.

    WAYS: which motors move, and how far per mm of way (see SingleMove). Of one of RAILS it stops all that
    moves when its endstop switches; of several (towers, sides of an axis) each stops its own steppers, and
    the move goes on until all have. SPEED in mm/s, ACCEL in mm/s². The machine stands still and each of RAILS
    has an endstop on a pin.
    """

    def __init__(
        self,
        machine: Machine,
        rails: Sequence[RailDescription],
        *,
        axis: str = "",
        direction: int = 1,
        ways: Mapping[str, float] | None = None,
        way_mm: float,
        speed: float,
        accel: float,
    ) -> None:
        self._machine = machine
        self._rails = rails
        self._ratio = ratio_of(axis, direction) if ways is None else WAY
        self._ways = ways
        self._ramp = Ramp(way_mm, speed, accel)
        self._heard_s: dict[tuple[int, str], float] = {}
        self._changed = asyncio.Event()
        self._move: SingleMove | None = None
        self._ends_at_s = 0.0
        """Print time at which one of the nodes stops by itself when it hears nothing more."""

    @property
    def planned_way_mm(self) -> float:
        """How far the move can have led by now, as it was planned and before nodes stop by themselves, mm."""
        if self._move is None:
            return 0.0
        until_s = min(self._move.print_time_now(), self._ends_at_s)
        return self._ramp.way_at(until_s - self._move.begin_s)

    async def run(self) -> tuple[HomingResult, ...]:
        """Move until every endstop switched; raises HomingError with everything stopped."""
        first = await self._machine.query_stepper_counts()
        for lead_s in LEADS_S[:-1]:
            with contextlib.suppress(_LateError):
                return await self._run(lead_s, first)
        return await self._run(LEADS_S[-1], first)

    async def _run(self, lead_s: float, first: dict[str, int]) -> tuple[HomingResult, ...]:
        """Try once, with the steppers having begun at FIRST: results count from there."""
        devices = self._machine.devices
        for rail in self._rails:
            node = self._machine.nodes[devices.endstop_node(rail)]
            if await self._is_pressed(rail, node):
                raise AlreadyPressedError(
                    f"the endstop of axis {rail.axis} is pressed before the move towards it; "
                    f"{_pressed_cure(rail)}"
                )
        began_at = await self._machine.query_stepper_counts()
        move = SingleMove(self._machine, self._ramp, self._ratio, ways=self._ways, lead_s=lead_s)
        self._move, self._ends_at_s = move, move.begin_s + TIMEOUT_ALONE_S
        legs = [self._leg(slot, rail, move) for slot, rail in enumerate(self._rails)]
        ends: list[Callable[[], None]] = []
        late: _LateError | None = None
        try:
            ends = [
                sync.listen(node, self._hear(leg, node, move)) for leg in legs for node, sync in leg.syncs
            ]
            await self._arm(move, legs)
            await self._until_triggered(move, legs)
        except _LateError as error:
            late = error
        finally:
            for end in ends:
                end()
            states = [await self._end(leg) for leg in legs]
        # Late for all this host knew: where the endstops switched it was in time, and they are pressed now.
        if late is not None and not all(map(_switched, legs, states)):
            raise late
        for leg, found in zip(legs, states, strict=True):
            self._check(leg, found)
        ended_at = await self._machine.query_stepper_counts()
        before = {s.name: began_at[s.name] - first[s.name] for s in move.steppers}
        moved = {s.name: ended_at[s.name] - first[s.name] for s in move.steppers}
        return tuple([await self._result(leg, move, before, moved) for leg in legs])

    async def _is_pressed(self, rail: RailDescription, node: Node) -> bool:
        """Look more than once: behind a move away from it, a switch may be seen to open late."""
        endstop = self._machine.devices.endstops[rail.axis]
        for _ in range(OPEN_LOOKS):
            if not (await endstop.state(node)).pressed:
                return False
            await asyncio.sleep(OPEN_LOOK_S)
        return True

    # ------------------------------------------------------------------------------------------ set up

    def _leg(self, slot: int, rail: RailDescription, move: SingleMove) -> _Leg:
        machine = self._machine
        node = machine.nodes[machine.devices.endstop_node(rail)]
        steppers = move.steppers if len(self._rails) == 1 else rail.steppers
        names = dict.fromkeys([node.name, *(stepper.node for stepper in steppers)])
        syncs = [(machine.nodes[name], machine.devices.trsyncs[slot, name]) for name in names]
        wires = {
            described.connection.interface
            if isinstance(described.connection, CanConnection)
            else described.name
            for described in machine.description.nodes
            if described.name in names
        }
        by_group = len(syncs) > 1 and len(wires) == 1 and all(sync.groups > slot for _, sync in syncs)
        endstop = machine.devices.endstops[rail.axis]
        return _Leg(rail, slot, endstop, node, steppers, syncs, by_group, asyncio.Event())

    async def _arm(self, move: SingleMove, legs: Sequence[_Leg]) -> None:
        for leg in legs:
            for node, sync in leg.syncs:
                self._arm_node(move, leg, node, sync)
        move.stream()  # the steps are on their way, too, before anything is waited for
        for node in {node for leg in legs for node, _ in leg.syncs}:
            await node.link.drained()
        if move.print_time_now() > move.begin_s:
            raise _LateError(
                _names(legs), "arming its nodes took too long; check the bus for errors and load"
            )

    def _arm_node(self, move: SingleMove, leg: _Leg, node: Node, sync: Trsync) -> None:
        self._heard_s[leg.slot, node.name] = move.print_time_now()
        if sync.groups:
            sync.join(node, leg.slot if leg.by_group else NO_GROUP)
        sync.start(
            node,
            report_clock=move.ticks_at(node.name, move.begin_s),
            report_ticks=round(leg.timeout_s / REPORTS * node.clock_freq_hz),
            timeout_clock=move.ticks_at(node.name, move.begin_s + leg.timeout_s),
        )
        for stepper in leg.steppers:
            if stepper.node == node.name:
                sync.stop_on_trigger(node, self._stepper_oid(stepper))
        if node is leg.endstop_node:
            assert sync.oid is not None
            leg.endstop.home(
                node,
                clock=move.ticks_at(node.name, move.begin_s),
                rest_ticks=leg.rest_ticks,
                trsync_oid=sync.oid,
            )

    def _stepper_oid(self, stepper: StepperDescription) -> int:
        oid = self._machine.devices.steppers[stepper.name].oid
        assert oid is not None
        return oid

    # ------------------------------------------------------------------------------------------ under way

    def _hear(self, leg: _Leg, node: Node, move: SingleMove) -> Callable[[TrsyncState], None]:
        """Return what takes the reports of one node's stop group."""

        def heard(state: TrsyncState) -> None:
            self._heard_s[leg.slot, node.name] = move.print_time_now()
            if state.armed or leg.triggered.is_set():
                return
            leg.triggered_s = move.print_time_now()
            leg.triggered.set()
            self._changed.set()
            _trigger(leg)

        return heard

    async def _until_triggered(self, move: SingleMove, legs: Sequence[_Leg]) -> None:
        while not all(leg.triggered.is_set() for leg in legs) and move.print_time_now() < move.end_s + LATE_S:
            move.stream()
            for leg in legs:
                self._renew(move, leg)
            self._changed.clear()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(CYCLE_S):
                    await self._changed.wait()
            if self._machine.stopped is not None:
                raise self._machine.stopped.with_traceback(None)

    def _renew(self, move: SingleMove, leg: _Leg) -> None:
        """Nobody is to go on longer than the host has heard from all."""
        heard_s = min(self._heard_s[leg.slot, node.name] for node, _ in leg.syncs)
        if leg.triggered.is_set() or heard_s <= move.begin_s:
            return
        self._ends_at_s = heard_s + leg.timeout_s
        for node, sync in leg.syncs:
            sync.renew(node, move.ticks_at(node.name, heard_s + leg.timeout_s))

    @staticmethod
    async def _end(leg: _Leg) -> dict[str, TrsyncState]:
        """Stop what is not stopped yet, drop what is queued; return how every node's round ended."""
        states = {}
        _trigger(leg)
        for node, sync in leg.syncs:
            try:
                states[node.name] = await sync.finish(node)
            except CanductorError as error:
                leg.unknown[node.name] = error
        with contextlib.suppress(CanductorError):
            leg.endstop.end(leg.endstop_node)
        return states

    def _check(self, leg: _Leg, states: dict[str, TrsyncState]) -> None:
        for node, _ in leg.syncs:
            if node.name not in states:
                raise node.failure or MoveEndedError(leg.name, str(leg.unknown[node.name]))
            if states[node.name].reason is TriggerReason.TIMEOUT:
                raise MoveEndedError(
                    leg.name,
                    f"node {node.name} did not hear from the host for {leg.timeout_s:g} s and stopped by"
                    " itself; check the bus for errors and load",
                )
        error = states[leg.endstop_node.name].reason.sensor_error
        if error is not None and isinstance(leg.endstop, SensorEndstop):
            raise MoveEndedError(leg.name, leg.endstop.error(error))
        if not _switched(leg, states):
            raise EndstopNotFoundError(
                f"axis {leg.name} moved {self._ramp.way_mm:g} mm and its endstop did not switch; "
                f"{_not_found_cure(leg.rail)}",
                self._ramp.way_mm,
            )

    # ------------------------------------------------------------------------------------------ afterwards

    async def _result(
        self, leg: _Leg, move: SingleMove, before: dict[str, int], moved: dict[str, int]
    ) -> HomingResult:
        triggered_at_s = await self._trigger_time(leg, move)
        to_trigger = _way(leg, move, before) + self._ramp.way_at(triggered_at_s - move.begin_s)
        own = {stepper.name: moved[stepper.name] for stepper in leg.steppers}
        return HomingResult(
            rail=leg.name,
            way_to_trigger_mm=to_trigger,
            way_mm=_way(leg, move, own),
            triggered_at_s=triggered_at_s,
            through_group=leg.by_group,
            moved=own,
            overshoots=tuple(_overshoot(move, s, own[s.name], to_trigger) for s in leg.steppers),
        )

    @staticmethod
    async def _trigger_time(leg: _Leg, move: SingleMove) -> float:
        """Return the print time of the first of the looks that found the endstop pressed.

        Its clock has 32 bits. Now may be too late to know which: other rails may have moved on for long.
        """
        state = await leg.endstop.state(leg.endstop_node)
        name = leg.endstop_node.name
        heard_s = move.print_time_now() if leg.triggered_s is None else leg.triggered_s
        near = Ticks(move.ticks_at(name, heard_s))
        return move.print_time_of(name, extend32(state.next_clock32, near) - leg.rest_ticks)


def _pressed_cure(rail: RailDescription) -> str:
    if not rail.homing.is_sensorless:
        return (
            "move the axis away by hand, or check the endstop's wiring and whether its pin has to be inverted"
        )
    return (
        "the motor still reports a stall, most likely because the axis stands at its end while another one"
        " moves along it: let one axis leave its end first (docs/tmc.md, Homing without switches)"
    )


def _not_found_cure(rail: RailDescription) -> str:
    if not rail.homing.is_sensorless:
        return "check the endstop's wiring, the direction of the axis, and homing_positive_dir"
    return (
        "raise the driver's sensitivity (driver_SGTHRS), check diag_pin, the direction of the axis, and"
        " homing_positive_dir (docs/tmc.md, Homing without switches)"
    )


def _way(leg: _Leg, move: SingleMove, steps: dict[str, int]) -> float:
    """Return how far a rail has gone, mm, by the STEPS of its steppers."""
    return sum(steps[s.name] * s.step_distance / move.along(s) for s in leg.steppers) / len(leg.steppers)


def _trigger(leg: _Leg) -> None:
    """Stop all nodes of LEG; one that is lost, which its own time-out stops, keeps no other from it."""
    for node, sync in leg.syncs:
        with contextlib.suppress(CanductorError):
            sync.trigger_now(node)


def _switched(leg: _Leg, states: Mapping[str, TrsyncState]) -> bool:
    """Return whether the endstop ended the round."""
    state = states.get(leg.endstop_node.name)
    return state is not None and state.reason is TriggerReason.ENDSTOP


def _overshoot(move: SingleMove, stepper: StepperDescription, moved: int, to_trigger: float) -> Overshoot:
    planned = move.planned_steps(stepper, to_trigger)
    along = move.along(stepper)
    steps = moved - math.floor(planned + 0.5)
    distance = (moved - planned) * stepper.step_distance / along
    return Overshoot(stepper.name, stepper.node, steps if along > 0 else -steps, distance)


def _names(legs: Sequence[_Leg]) -> str:
    return ", ".join(leg.name for leg in legs)

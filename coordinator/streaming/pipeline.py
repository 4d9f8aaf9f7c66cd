"""From a G-code job to every node's command batches: planner and step generation joined.

The batch planner and the real-time streamer both drive this; it does no I/O beyond reading the job's
program and keeps no clock. Not thread-safe: one thread at a time.
"""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from coordinator.gcode.events import (
    AS_SOON_AS_POSSIBLE,
    MachineChange,
    PositionSet,
    ShaperChange,
    SmoothTimeChange,
    SurfaceChange,
    Timed,
    WeightsChange,
)
from coordinator.gcode.machine_state import SHAPER_AXES, Shaper
from coordinator.motion.moves import MOVE_BYTES, copied
from coordinator.motion.planner.planner import Planner, Position
from coordinator.motion.steps.shapers import Impulses, shaper_impulses
from coordinator.motion.steps.steps import StepGenerator
from coordinator.motion.steps.surface import Surface
from coordinator.runtime.filament_forecast import FilamentForecast
from coordinator.streaming.compensation import Compensation
from coordinator.streaming.move_source import MoveSource

BatchSink = Callable[[int, bytes], None]
"""Takes a node's index and a piece of its stream (nodes/link/core/batch.h)."""

MoveWatch = Callable[[Any, int], None]
"""Takes a pointer to trapezoids, and how many there are, as they go to step generation."""

BATCH_ROOM = 1 << 16


@dataclass(frozen=True, slots=True)
class MotionSettings:
    """Settings of step generation, between trapezoids and steppers."""

    shapers: Mapping[str, Shaper]
    """By axis letter."""
    weights: Mapping[str, Position]
    """By stepper, of those that were given others than their configuration says."""
    windows_s: Mapping[str, float]
    """By filament stepper: the window over which pressure advance is spread."""
    surface: Surface | None = None
    """The shape of the bed."""


@dataclass(slots=True)
class PlanRecord:
    """Record of what was planned, for a proof: moves in order, and where positions were declared."""

    start: Position
    pieces: list[bytes] = field(default_factory=list)
    """Moves (motion/moves.py)."""
    declared: list[tuple[int, Position]] = field(default_factory=list)
    """Before move number N the machine was declared to stand at a position."""
    count: int = 0
    settings: list[tuple[int, MotionSettings]] = field(default_factory=list)
    """Settings from move number N on."""

    def restart(self) -> None:
        """Forget all: something else has moved the machine."""
        self.pieces.clear()
        self.declared.clear()
        self.settings.clear()
        self.count = 0

    def add(self, moves: bytes) -> None:
        """Keep MOVES."""
        self.pieces.append(moves)
        self.count += len(moves) // MOVE_BYTES

    def every(self) -> bytes:
        """Return all moves."""
        return b"".join(self.pieces)


class Pipeline:
    """Moves of JOB (any source), planned by its planner, turned by STEPS into batches that SINK takes."""

    def __init__(
        self,
        job: MoveSource,
        steps: StepGenerator,
        sink: BatchSink,
        *,
        nodes: int,
        record: PlanRecord | None = None,
        watch: MoveWatch | None = None,
        compensation: "Compensation | None" = None,
        filament: "FilamentForecast | None" = None,
    ) -> None:
        self.job = job
        self.steps = steps
        self._sink = sink
        self._nodes = nodes
        self._record = record
        self._watch = watch
        self._compensation = compensation
        self._filament = filament
        self._appended_until = 0.0
        self._shapers: dict[str, Shaper] = {}
        self._weights: dict[str, Position] = {}
        self._windows_s: dict[str, float] = {}
        self._surface: Surface | None = None
        self.moves = 0
        """Trapezoids handed to step generation."""
        self.moved_until = 0.0
        """Print time at which the last of them ends, in s."""
        self.due: list[tuple[float, Timed]] = []
        """Events with the print time at which they take effect, for the owner to take out."""
        self._timed: deque[tuple[float | None, Timed]] = deque()
        """With the print time where they stand, if the machine stands there: a dwell may follow."""
        self._moves_before = job.planner.moves
        self._begin()

    @property
    def planner(self) -> Planner:
        """The job's planner."""
        return self.job.planner

    @property
    def appended_until(self) -> float:
        """Print time up to which step generation has all moves, in s."""
        return self._appended_until

    def act(self, event: PositionSet | MachineChange) -> None:
        """Carry out EVENT; all moves are generated, and all steps that they cause."""
        match event:
            case PositionSet():
                self._declare(event)
                self.compensate()
            case ShaperChange():
                self._shape(event.axis, Shaper(event.kind, event.frequency_hz, event.damping_ratio))
            case WeightsChange():
                self._follow(event.weights)
                self._smooth()
            case SmoothTimeChange():
                self._smooth()
            case SurfaceChange():
                self._follow_bed(event.surface)
        self._note_settings()
        self.planner.begin_at(self.steps.next_move_s)

    def _begin(self) -> None:
        """Set step generation up for the state of the job's machine."""
        machine = self.job.machine
        for axis, shaper in machine.shapers.items():
            self._shape(axis, shaper)
        if machine.filament is not None:
            self._follow(machine.filament.weights())
        if machine.carriages is not None and machine.carriage_state is not None:
            self._follow(machine.carriages.weights(machine.carriage_state))
        self._follow(machine.follows)
        self._smooth()
        self._follow_bed(machine.surface)
        self._note_settings()
        self.planner.begin_at(self.steps.next_move_s)

    def _note_settings(self) -> None:
        """Record the settings from here on."""
        if self._record is None:
            return
        shapers = {axis: shaper for axis, shaper in self._shapers.items() if shaper.frequency_hz}
        settings = MotionSettings(shapers, dict(self._weights), dict(self._windows_s), self._surface)
        self._record.settings.append((self._record.count, settings))

    def _shape(self, axis: str, shaper: Shaper) -> None:
        self._shapers[axis] = shaper
        impulses: Impulses = ()
        if shaper.frequency_hz:
            impulses = shaper_impulses(shaper.kind, shaper.frequency_hz, shaper.damping_ratio)
        self.steps.set_shaper(SHAPER_AXES.index(axis), impulses)

    def _follow(self, weights: Mapping[str, Position]) -> None:
        if self._filament is not None:
            self._filament.follow(weights)
        for name, axes in weights.items():
            self.steps.set_weights(self.steps.index(name), axes)
            self._weights[name] = axes

    def _smooth(self) -> None:
        """Give every filament stepper the window of the extruder whose motion it follows."""
        machine = self.job.machine
        if machine.filament is None:
            return
        for stepper, extruder in machine.filament.followed.items():
            window_s = machine.extruders[extruder].window_s if extruder else 0.0
            self.steps.set_smooth_time(self.steps.index(stepper), window_s)
            self._windows_s[stepper] = window_s

    def _follow_bed(self, surface: Surface | None) -> None:
        self._surface = surface
        self.steps.set_surface(surface)

    def _declare(self, event: PositionSet) -> None:
        before = self.steps.corrections if self._compensation is not None else ()
        self.steps.set_axis_position(event.position)
        if self._compensation is not None:
            self._compensation.declared(self.steps, before, event.axes)
        if self._record is not None:
            self._record.declared.append((self._record.count, event.position))

    @property
    def compensation_due(self) -> bool:
        """Whether ``compensate`` has something to do, when all moves are generated."""
        return self._compensation is not None and self._compensation.is_due(self.planner.homed)

    def compensate(self) -> None:
        """Take up the axis tables that are wanted, on homed axes; all moves are generated."""
        if self._compensation is not None:
            self._compensation.take_up(self.steps, self.planner.homed)

    def at_next_move(self, event: Timed) -> None:
        """Keep EVENT until it is known when the move behind it begins: see ``due``."""
        if event.after_moves == AS_SOON_AS_POSSIBLE:
            self.due.append((0.0, event))
        else:
            at_s = self.planner.print_time_end_s if self.planner.at_standstill else None
            self._timed.append((at_s, event))

    def _find_due(self, moves: Any, count: int) -> None:
        """Look for the begin of waiting events among MOVES, the next COUNT."""
        first = self._moves_before + self.moves
        while self._timed and self._timed[0][1].after_moves < first + count:
            at_s, event = self._timed.popleft()
            if at_s is None:
                at_s = float(moves[max(0, event.after_moves - first)].print_time)
            self.due.append((at_s, event))

    def transfer(self) -> bool:
        """Hand planned moves to step generation while it has room; return whether all were handed over."""
        while (waiting := self.planner.take()).count:
            taken = self.steps.append(waiting.pointer, waiting.count)
            if taken:
                last = waiting.pointer[taken - 1]
                end = last.print_time + last.accel_s + last.cruise_s + last.decel_s
                self._appended_until = self.moved_until = float(end)
                if self._timed:
                    self._find_due(waiting.pointer, taken)
                self.moves += taken
                if self._watch is not None:
                    self._watch(waiting.pointer, taken)
                if self._filament is not None:
                    self._filament.see_moves(waiting.pointer, taken)
                if self._record is not None:
                    self._record.add(copied(waiting.pointer, taken))
                self.planner.release(taken)
            if taken < waiting.count:
                return False
        self._appended_until = max(self._appended_until, self.planner.print_time_end_s)
        if self._timed and self.planner.at_standstill:  # no move comes behind them for now
            end_s = self._appended_until
            self.due += [(end_s if at_s is None else at_s, event) for at_s, event in self._timed]
            self._timed.clear()
        return True

    def generate(self, until: float, *, flush: bool = False) -> None:
        """Make the commands of everything before print time UNTIL and pass them on."""
        until = max(until, self.steps.generated_until)
        while True:
            done = self.steps.generate(until, flush=flush)
            for node in range(self._nodes):
                while batch := self.steps.take_batch(node, BATCH_ROOM):
                    self._sink(node, batch)
            if done:
                return

    def run_through(self) -> None:
        """Turn everything that is planned into batches, however much; what may still grow is held back."""
        while not self.transfer():
            self.generate(self._appended_until)
        self.generate(self._appended_until)

    def finish(self) -> None:
        """Plan all moves to a standstill and turn them into batches, to the last step."""
        while not self.planner.flush():
            self.run_through()
        self.run_through()
        self.generate(self._appended_until + self.steps.lag_s, flush=True)
        self.planner.begin_at(self.steps.next_move_s)

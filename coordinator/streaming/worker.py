"""The half of streaming that costs time: the job's g-code, planning, step generation.

A MotionWorker's ``work`` and ``rest`` run in a thread of their own, one at a time, mostly without the
interpreter lock; the control loop (``streamer.py``) looks at the rest of it only between them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from coordinator.gcode.events import (
    Emergency,
    Event,
    MachineChange,
    Notice,
    PositionSet,
    Progress,
    Reply,
    StandstillAction,
    Timed,
    Wait,
)
from coordinator.gcode.status import MotionStatus
from coordinator.motion.planner.planner import Planner
from coordinator.motion.steps.steps import SHORT_S, Issued, StepGenerator
from coordinator.runtime.machine import Machine
from coordinator.runtime.timebase import ClockMap, JumpWatch
from coordinator.streaming.compensation import Compensation
from coordinator.streaming.move_source import MoveSource, Planned, ProgramOutput, Witness
from coordinator.streaming.pipeline import Pipeline, PlanRecord
from coordinator.streaming.timed_events import Due

PLAN_AHEAD_S: Final = 2.3
"""Moves are planned so far ahead of now; beyond, the g-code waits. A pause takes so long; what it leaves
beyond MAKE_AHEAD_S is for sources that stall, and for lines that take longer to read than to carry out."""
MAKE_AHEAD_S: Final = 1.8
"""Step commands are made so far ahead of now; the clocks of the nodes are predicted over this long. Links
send them later (LinkSettings.ahead_s), so that less goes on when this program is gone."""
START_LEAD_S: Final = 0.25
"""From standstill, the first move begins so far ahead of now."""
RUN_DRY_S: Final = 0.8
"""When what is planned ends so soon and no more comes, it is planned to a standstill."""
REST_BORDER_S: Final = 0.15
"""At rest everything up to so far ahead of now counts as generated; below START_LEAD_S."""
LINES_AT_ONCE: Final = 200
READ_S: Final = 0.1
"""G-code is read for so long in one cycle, and to the end of the step at hand: commands are due meanwhile."""
OUTPUT_AT_ONCE: Final = 50
"""Replies and notices of one cycle: the control loop shows them in one turn."""
OUTPUT_CHARS_AT_ONCE: Final = 65_536
"""Likewise; the one that reaches it is the last one."""


@dataclass(frozen=True, slots=True)
class Cycle:
    """What one visit to the worker brought."""

    batches: list[tuple[int, bytes]]
    output: list[ProgramOutput]
    event: Event | None
    """What the job waits for; None: it has more."""
    planned: Planned
    due: list[Due]
    stepping: list[str]
    """Steppers that have steps in the batches."""
    more: bool = False
    """Whether lines of clients were left for the next cycle, which EVENT does not hold up."""


class MotionWorker:
    """Turns JOB into batches of commands for MACHINE's nodes, as time goes by."""

    def __init__(
        self,
        machine: Machine,
        job: MoveSource,
        *,
        record: PlanRecord | None,
        witness: Witness | None,
        compensation: "Compensation | None",
    ) -> None:
        self._machine = machine
        self._job = job
        self._record = record
        self._witness = witness
        self._compensation = compensation
        self._nodes = machine.moving
        self._time_base = machine.time_base()
        self._batches: list[tuple[int, bytes]] = []
        self.began_at: dict[str, int] = {}
        """By stepper: steps that its node counted when motion last started."""
        now_s = self._time_base.print_time_at(machine.host.now())
        self.maps: list[ClockMap] = [machine.clock_map(self._time_base, node, now_s) for node in self._nodes]
        """Per moving node: print time to ticks, as the steps were timed; without a record only its end."""
        self._jumps = JumpWatch((machine.primary, *self._nodes))
        self.start_lead_s = START_LEAD_S
        self.held: str | None = None
        """Why the g-code waits, or None."""
        self._set_up()

    def _set_up(self) -> None:
        """Create step generation, again whenever something else has moved the steppers."""
        machine, witness = self._machine, self._witness
        self._made: dict[str, int] = {}
        specs = machine.devices.stepper_specs()
        self.steps = StepGenerator(specs, machine.stream_specs(), longest_s=SHORT_S)
        self.pipeline = Pipeline(
            self._job,
            self.steps,
            lambda n, b: self._batches.append((n, b)),
            nodes=len(self._nodes),
            record=self._record,
            watch=None if witness is None else witness.see_moves,
            compensation=self._compensation,
            filament=machine.filament if machine.filament.is_wanted else None,
        )

    @property
    def _planner(self) -> Planner:
        return self._job.planner

    def print_time_now(self) -> float:
        """Return the present print time."""
        return self._time_base.print_time_at(self._machine.host.now())

    def begin(self) -> float:
        """Begin now: set the nodes' clocks; return the print time of the first move."""
        began_s = self.print_time_now() + self.start_lead_s
        self._planner.begin_at(began_s)
        self.maps = []
        for index, node in enumerate(self._nodes):
            clock_map = self._machine.clock_map(self._time_base, node, self.print_time_now())
            piece = clock_map.last
            self.steps.set_clock_base(index, piece.print_time, round(piece.ticks), piece.ticks_per_s)
            self.maps.append(clock_map)
        return began_s

    def begin_again(self, began_at: dict[str, int]) -> float:
        """Go on where something else has left the steppers, at BEGAN_AT; the rest as ``begin``."""
        self.began_at = began_at
        if self._record is not None:
            self._record.restart()
        if self._compensation is not None:
            self._compensation.begin_again(self.steps)
        self._set_up()
        return self.begin()

    # ---------------------------------------------------------------------------- in the worker's thread

    def work(self, waiting_for: Event | None) -> Cycle:
        """Run the job as far as it should be by now, and make the commands that are due."""
        now = self.print_time_now()
        output: list[ProgramOutput] = []
        event, more = waiting_for, False
        if 0 < self.steps.generated_until < now and self._planner.at_standstill:
            self._generate(now)  # after a long rest: clocks are steered from now on, not from the last cycle
        if self.pipeline.compensation_due and self._all_generated():
            self.pipeline.compensate()
        held = self.held is not None
        if not held and not self._still_waiting(waiting_for, now):
            self._planner.plan_until_s = now + PLAN_AHEAD_S
            self._delay_after_standstill(now)
            event = self._advance(output)
        elif isinstance(waiting_for, StandstillAction) and not waiting_for.over:
            event, more = self._attend_others(waiting_for, output)
        now = self.print_time_now()  # lines may have taken a while
        if held or self._runs_dry(now):
            self._planner.flush()
        self._generate(now)
        return self._cycle(output, event, more=more)

    def _attend_others(self, resting: StandstillAction, output: list[ProgramOutput]) -> tuple[Event, bool]:
        """Execute lines of clients while the job waits, maybe minutes.

        Returns what to wait for, and whether there are more.
        """
        ends_s = self.print_time_now() + READ_S
        while (event := self._job.attend_others()) is not None:
            if isinstance(event, Reply | Notice):
                output.append(event)
            elif isinstance(event, Timed):
                self.pipeline.at_next_move(event)
            elif isinstance(event, Emergency):
                return event, False
            if self.print_time_now() >= ends_s:
                return resting, True
        return resting, False

    def rest(self) -> Cycle:
        """Make the commands that are due; the job is over."""
        self._generate(self.print_time_now())
        return self._cycle([], None)

    def _cycle(self, output: Sequence[ProgramOutput], event: Event | None, *, more: bool = False) -> Cycle:
        batches, self._batches = self._batches, []
        due, self.pipeline.due = self.pipeline.due, []
        if self._compensation is not None:
            self._compensation.note(self.steps)
        steppers = self.steps.issued()
        stepping = self._stepping(steppers) if batches else []
        return Cycle(batches, list(output), event, self._planned(steppers), due, stepping, more)

    def _stepping(self, steppers: Sequence[Issued]) -> list[str]:
        """Return the steppers for which steps were made since the last time."""
        made = {s.name: s.steps for s in steppers}
        before, self._made = self._made, made
        return [name for name, steps in made.items() if steps != before.get(name, 0)]

    def _planned(self, steppers: Sequence[Issued]) -> Planned:
        planner = self._planner
        stands = planner.at_standstill and not planner.take().count
        return Planned(
            MotionStatus.of(planner, self._job.machine),
            stands_from_s=self.pipeline.moved_until + self.steps.lag_s if stands else None,
            steps_sent=tuple(self._count(stepper) for stepper in steppers),
            last_step_clocks=tuple(stepper.issued_clock for stepper in steppers),
        )

    def _still_waiting(self, event: Event | None, now: float) -> bool:
        if isinstance(event, Wait):
            return now < event.print_time_s
        if isinstance(event, PositionSet | MachineChange):
            return not self._acted(event)
        if isinstance(event, StandstillAction):
            return not event.over
        return False

    def _acted(self, event: PositionSet | MachineChange) -> bool:
        """Carry out EVENT once all moves before it are generated; return whether it was."""
        if not self._all_generated():
            return False
        self.pipeline.act(event)
        self._note_positions(event)
        return True

    def _note_positions(self, event: PositionSet | MachineChange) -> None:
        """Record at the machine which counts of its nodes correspond to the present positions."""
        carriages = self._job.machine.carriage_state
        if isinstance(event, PositionSet):
            offsets = [correction.offset_mm for correction in self.steps.corrections]
            position = self._job.machine.motor_position(event.position)
            self._machine.stepper_positions.declare(position, self._counts(), carriages, offsets)
        else:
            self._machine.stepper_positions.use(carriages)

    def _counts(self) -> dict[str, int]:
        """Return where the nodes will count the steppers when all that was made is executed."""
        return {stepper.name: self._count(stepper) for stepper in self.steps.issued()}

    def _count(self, stepper: Issued) -> int:
        return stepper.issued + self.began_at.get(stepper.name, 0)

    def _all_generated(self) -> bool:
        return (
            self._planner.at_standstill
            and self.pipeline.transfer()
            and self.steps.generated_until >= self.pipeline.appended_until + self.steps.lag_s
        )

    def _advance(self, output: list[ProgramOutput]) -> Event | None:
        """Step the job until it has to wait for something, or as much as one cycle may have is done."""
        chars, ends_s = 0, self.print_time_now() + READ_S
        for _ in range(LINES_AT_ONCE):
            if self.print_time_now() >= ends_s:
                return None
            event = self._job.step()
            if isinstance(event, Reply | Notice):
                output.append(event)
                chars += len(event.text)
                if len(output) >= OUTPUT_AT_ONCE or chars >= OUTPUT_CHARS_AT_ONCE:
                    return None
            elif isinstance(event, Progress):
                continue
            elif isinstance(event, Timed):
                self.pipeline.at_next_move(event)
            elif isinstance(event, PositionSet | MachineChange) and self._acted(event):
                continue
            else:
                return event
        return None

    def _delay_after_standstill(self, now: float) -> None:
        """After a standstill the next move needs time to reach the nodes, and steps to look ahead to it."""
        begin = max(now + self.start_lead_s, self.steps.next_move_s)
        if self._planner.at_standstill and self._planner.print_time_end_s < begin:
            self._planner.begin_at(begin)

    def _runs_dry(self, now: float) -> bool:
        return self._planner.print_time_end_s < now + RUN_DRY_S and not self._planner.at_standstill

    def _generate(self, now: float) -> None:
        """Make the commands up to MAKE_AHEAD_S from now, with every node's clock steered first."""
        self._jumps.look(now, self.pipeline.moved_until + self.steps.lag_s)
        while True:
            complete = self.pipeline.transfer()
            self._steer()
            standing = complete and self._planner.at_standstill
            end = self.pipeline.appended_until
            until = min(end, now + MAKE_AHEAD_S)
            flush = standing and until >= end
            # At rest the border moves on with time, so that the clocks are steered at all times.
            self.pipeline.generate(max(until, now + REST_BORDER_S) if flush else until, flush=flush)
            if complete or until < end:
                return

    def _steer(self) -> None:
        border = self.steps.generated_until
        for index, (node, clock_map) in enumerate(zip(self._nodes, self.maps, strict=True)):
            if node is not self._machine.primary and border > clock_map.last.print_time:
                piece = self._time_base.steer(node.name, clock_map, node.best_clock, border)
                self.steps.set_clock(index, piece.ticks_per_s)
                if self._record is None:
                    clock_map.forget()

"""Real time: feeds a job's motion to the nodes, early enough and not too early.

The control loop wakes every CYCLE_S. What costs time (the job's g-code, planning, step generation) runs in
one worker thread without the interpreter lock; the loop only hands finished batches to the links.
"""

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from coordinator.app import Machine, MachineStopped, link_of
from coordinator.gcode.errors import GCodeError
from coordinator.gcode.events import (
    Emergency,
    End,
    Event,
    Full,
    MachineChange,
    Notice,
    PositionSet,
    Progress,
    Reply,
    Resting,
    Timed,
    Wait,
)
from coordinator.motion.planner import Planner
from coordinator.motion.steps import StepGenerator
from coordinator.move_source import JobState, MoveSource, Planned, Told, Witness
from coordinator.pipeline import Pipeline, PlanRecord
from coordinator.resting import RestTask
from nodes.errors import CanductorError

if TYPE_CHECKING:
    from coordinator.compensation import Compensation
    from coordinator.timebase import ClockMap

CYCLE_S: Final = 0.05
PLAN_AHEAD_S: Final = 2.0
"""Moves are planned so far ahead of now; beyond, the g-code waits. A pause takes so long; what it leaves
beyond SEND_AHEAD_S is for sources that stall, and for lines that take longer to read than to carry out."""
SEND_AHEAD_S: Final = 1.2
"""Step commands are made so far ahead of now; the clocks of the nodes are predicted over this long."""
START_LEAD_S: Final = 0.25
"""From standstill, the first move begins so far ahead of now."""
BUSY_START_LEAD_S: Final = 0.6
"""The same on a bus with other traffic, where the first commands, dense as in every ramp, take longer."""
BUSY_LOAD: Final = 0.3
"""Share of a bus's time from which it counts as busy."""
RUN_DRY_S: Final = 0.8
"""When what is planned ends so soon and no more comes, it is planned to a standstill."""
REST_BORDER_S: Final = 0.15
"""At rest everything up to so far ahead of now counts as generated; below START_LEAD_S."""
SETTLE_S: Final = 0.05
"""After the last step is due, before it is believed to be done."""
CAUSE_WAIT_S: Final = 0.1


@dataclass(frozen=True, slots=True)
class _Cycle:
    """What one visit to the worker brought."""

    batches: list[tuple[int, bytes]]
    told: list[Told]
    event: Event | None
    """What the job waits for; None: it has more."""
    planned: Planned
    due: list[tuple[float, Timed]]


class Streamer:
    """Runs one JOB on MACHINE, whose nodes are READY. ON_TOLD gets replies and notices, ON_STATE progress.

    WITNESS sees the moves and the commands go by, COMPENSATION has the tables of the axes.
    """

    def __init__(
        self,
        machine: Machine,
        job: MoveSource,
        *,
        record: PlanRecord | None = None,
        witness: Witness | None = None,
        compensation: "Compensation | None" = None,
        on_told: Callable[[Told], None],
        on_state: Callable[[JobState], None],
    ) -> None:
        self._machine = machine
        self.began_at: dict[str, int] = {}
        """By stepper: where its node says that it stood when motion was last begun anew; for the owner."""
        self._job = job
        self._on_told = on_told
        self._on_state = on_state
        self._witness = witness
        self._compensation = compensation
        self._keeps_maps = record is not None
        self._nodes = machine.moving
        self._time_base = machine.time_base()
        self._record = record
        self._batches: list[tuple[int, bytes]] = []
        self._set_up()
        self.maps: list[ClockMap] = []
        """Per moving node: print time to ticks, as the steps were timed; without a record only its end."""
        self.began_s = 0.0
        """Print time at which the job began, or went on after something else had moved the machine."""
        self.ended_s = 0.0
        self._resting: RestTask | None = None
        self._done = Progress(0, 0, None)
        self._failure: GCodeError | None = None
        self._held: str | None = None
        self._start_lead_s = START_LEAD_S

    def _set_up(self) -> None:
        """Make step generation, which begins anew whenever something else has moved the steppers."""
        machine, witness = self._machine, self._witness
        self.steps = StepGenerator(machine.devices.stepper_specs(), machine.stream_specs())
        self.pipeline = Pipeline(
            self._job,
            self.steps,
            lambda n, b: self._batches.append((n, b)),
            nodes=len(self._nodes),
            record=self._record,
            watch=None if witness is None else witness.see_moves,
            compensation=self._compensation,
        )

    @property
    def _planner(self) -> Planner:
        return self._job.planner

    def print_time_now(self) -> float:
        """Return the present print time."""
        return self._time_base.print_time_at(self._machine.host.now())

    def hold(self, cause: str) -> None:
        """Let the g-code wait, from the control loop: what is planned is carried out, to a standstill.

        CAUSE is a sentence. The end of a job that has been read to its end is not held up.
        """
        self._held = cause

    def release(self) -> None:
        """Let the g-code go on after ``hold``."""
        self._held = None

    @property
    def held(self) -> str | None:
        """Why the g-code waits, or None."""
        return self._held

    async def run(self) -> None:
        """Run the job to its end: until the last step is executed.

        Raises MachineStopped when the machine stops meanwhile, CanductorError when the job or a link fails;
        the machine is stopped then.
        """
        self._begin()
        with self._machine.job(self):
            await self._run()

    async def _run(self) -> None:
        work = asyncio.ensure_future(self._stream())
        watch = asyncio.ensure_future(self._machine.wait_stopped())
        try:
            await asyncio.wait((work, watch), return_when=asyncio.FIRST_COMPLETED)
            if not watch.done() and work.exception() is not None:
                await self._stop_after(work.exception(), watch)
            if watch.done():
                raise watch.result()
            work.result()
        finally:
            for task in (work, watch):
                task.cancel()
            await asyncio.gather(work, watch, return_exceptions=True)
            if self._resting is not None:
                await self._resting.close()

    async def _stop_after(self, error: BaseException | None, watch: asyncio.Future[MachineStopped]) -> None:
        """Stop the machine after ERROR of the stream, unless it is that of a program and all stands still."""
        if isinstance(error, GCodeError):
            return
        # The link may have failed a moment before its node is known to be lost: that is the better cause.
        await asyncio.wait((watch,), timeout=CAUSE_WAIT_S)
        self._machine.stop(f"{error}; all nodes were stopped")
        await watch

    # ------------------------------------------------------------------------------------------- streaming

    def _begin(self) -> None:
        self._look_at_load()
        self.began_s = self.print_time_now() + self._start_lead_s
        self._planner.begin_at(self.began_s)
        self.maps = []
        for index, node in enumerate(self._nodes):
            clock_map = self._machine.clock_map(self._time_base, node, self.print_time_now())
            piece = clock_map.last
            self.steps.set_clock_base(index, piece.print_time, round(piece.ticks), piece.ticks_per_s)
            self.maps.append(clock_map)

    async def _stream(self) -> None:
        loop = asyncio.get_running_loop()
        with ThreadPoolExecutor(1, thread_name_prefix="motion") as worker:
            event: Event | None = None
            while not isinstance(event, End):
                cycle = await loop.run_in_executor(worker, self._work, event)
                event = cycle.event
                self._hand_over(cycle)
                if isinstance(event, Emergency):
                    self._machine.stop(f"{self._job.name}:{event.line}: M112 stopped the machine")
                    return
                if isinstance(event, Resting):
                    await self._attend(event)
                if event is not None or self._held is not None:
                    await asyncio.sleep(CYCLE_S)
            self.ended_s = self._planner.print_time_end_s
            await self._settle(worker)
        if self._failure is not None:
            raise self._failure

    async def _attend(self, event: Resting) -> None:
        """Have EVENT performed once all moves before it are executed."""
        if self._resting is None:
            if self.print_time_now() < event.print_time_s + self.steps.lag_s + SETTLE_S:
                return
            self._resting = RestTask(event)
        if self._resting.look():
            self._resting = None
            if event.moved:
                await self._begin_again()

    async def _begin_again(self) -> None:
        """Go on where something else has left the steppers."""
        self.began_at = await self._machine.stepper_positions()
        if self._record is not None:
            self._record.restart()
        if self._compensation is not None:
            self._compensation.begin_again(self.steps)
        self._set_up()
        self._begin()

    def _hand_over(self, cycle: _Cycle) -> None:
        if cycle.batches:
            self._machine.modules.before_motion()
        for node, batch in cycle.batches:
            link_of(self._nodes[node]).send_batch(batch)
            if self._witness is not None:
                self._witness.see_batch(node, batch)
        if cycle.batches:
            self._machine.check_load()
        self._look_at_load()
        for told in cycle.told:
            self._on_told(told)
        for print_time_s, timed in cycle.due:
            try:
                timed.act(print_time_s)
            except CanductorError as error:  # such as the loss of a node that may be missing
                self._on_told(Notice(timed.line, f"{self._job.name}:{timed.line}: {error}"))
        self._report(cycle.planned)

    def _look_at_load(self) -> None:
        busy = any(bus.load.total > BUSY_LOAD for bus in self._machine.bus_stats().values())
        self._start_lead_s = BUSY_START_LEAD_S if busy else START_LEAD_S

    def _report(self, planned: Planned) -> None:
        now = self.print_time_now()
        self._on_state(
            JobState(
                self._done.done_bytes,
                self._done.size_bytes,
                max(0.0, min(now, self.pipeline.appended_until) - self.began_s),
                self.pipeline.moves,
                planned,
            )
        )

    async def _settle(self, worker: ThreadPoolExecutor) -> None:
        """Bring what is left to the nodes and wait until the last step is executed."""
        loop = asyncio.get_running_loop()
        while self.print_time_now() < self.ended_s + self.steps.lag_s + SETTLE_S:
            self._hand_over(await loop.run_in_executor(worker, self._rest))
            await asyncio.sleep(CYCLE_S)
        for node in self._nodes:
            await link_of(node).drained()

    # ---------------------------------------------------------------------------- in the worker's thread

    def _work(self, waiting_for: Event | None) -> _Cycle:
        """Let the job go on as far as it should by now, and make the commands that are due."""
        now = self.print_time_now()
        told: list[Told] = []
        event = waiting_for
        if self.pipeline.compensation_due and self._all_generated():
            self.pipeline.compensate()
        held = self._held is not None and self._failure is None
        if self._failure is None and not held and not self._still_waiting(waiting_for, now):
            self._planner.plan_until_s = now + PLAN_AHEAD_S
            self._begin_anew(now)
            try:
                event = self._advance(told)
            except GCodeError as error:
                # What came before the bad line is carried out, to a standstill.
                self._failure = error
        if self._failure is not None:
            event = self._end_early()
        if held or self._runs_dry(now):
            self._planner.flush()
        self._generate(now)
        return self._cycle(told, event)

    def _end_early(self) -> Event:
        return End(self._job.line, self._planner.print_time_end_s) if self._planner.flush() else Full()

    def _rest(self) -> _Cycle:
        self._generate(self.print_time_now())
        return self._cycle([], None)

    def _cycle(self, told: Sequence[Told], event: Event | None) -> _Cycle:
        batches, self._batches = self._batches, []
        due, self.pipeline.due = self.pipeline.due, []
        if self._compensation is not None:
            self._compensation.note(self.steps)
        return _Cycle(batches, list(told), event, self._planned(), due)

    def _planned(self) -> Planned:
        planner = self._planner
        stands = planner.at_standstill and not planner.take().count
        return Planned(
            position=planner.toolhead_position,
            gcode=planner.gcode_position,
            base=planner.gcode_base,
            homed=planner.homed,
            speed_factor=planner.speed_factor,
            extrude_factor=planner.extrude_factor,
            stands_from_s=self.pipeline.moved_until + self.steps.lag_s if stands else None,
            steps_sent=tuple(s.issued + self.began_at.get(s.name, 0) for s in self.steps.stats().steppers),
        )

    def _still_waiting(self, event: Event | None, now: float) -> bool:
        if isinstance(event, Wait):
            return now < event.print_time_s
        if isinstance(event, PositionSet | MachineChange):
            return not self._acted(event)
        if isinstance(event, Resting):
            return not event.over
        return False

    def _acted(self, event: PositionSet | MachineChange) -> bool:
        """Carry out EVENT once all moves before it are generated; return whether it was."""
        if not self._all_generated():
            return False
        self.pipeline.act(event)
        return True

    def _all_generated(self) -> bool:
        return (
            self._planner.at_standstill
            and self.pipeline.transfer()
            and self.steps.generated_until >= self.pipeline.appended_until + self.steps.lag_s
        )

    def _advance(self, told: list[Told]) -> Event | None:
        """Step the job until it has to wait for something, or a few hundred lines are done."""
        for _ in range(200):
            event = self._job.step()
            if isinstance(event, Reply | Notice):
                told.append(event)
            elif isinstance(event, Progress):
                self._done = event
            elif isinstance(event, Timed):
                self.pipeline.at_next_move(event)
            elif isinstance(event, PositionSet | MachineChange) and self._acted(event):
                continue
            else:
                return event
        return None

    def _begin_anew(self, now: float) -> None:
        """After a standstill the next move needs time to reach the nodes, and steps to look ahead to it."""
        begin = max(now + self._start_lead_s, self.steps.next_move_s)
        if self._planner.at_standstill and self._planner.print_time_end_s < begin:
            self._planner.begin_at(begin)

    def _runs_dry(self, now: float) -> bool:
        return self._planner.print_time_end_s < now + RUN_DRY_S and not self._planner.at_standstill

    def _generate(self, now: float) -> None:
        """Make the commands up to SEND_AHEAD_S from now, with every node's clock steered first."""
        while True:
            complete = self.pipeline.transfer()
            self._steer()
            standing = complete and self._planner.at_standstill
            end = self.pipeline.appended_until
            until = min(end, now + SEND_AHEAD_S)
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
                if not self._keeps_maps:
                    clock_map.forget()

"""Real time: feeds a job's motion to the nodes, early enough and not too early.

What costs time (the job's g-code, planning, step generation) runs in one worker thread
(``motion_worker.py``), cycle by cycle; the loop only hands finished batches to the links. The next cycle
comes when there may be something to do: after CYCLE_S, within FULL_CYCLE_S while everything is made as far
ahead as it may be, after REST_CYCLE_S while the machine has nothing to do; or at once, by ``call``.
"""

import asyncio
import math
from collections.abc import Callable, Sequence
from typing import Final

from coordinator.gcode.events import Emergency, End, Event, Full, Idle, Notice, StandstillAction
from coordinator.runtime.bus_overload import BusOverload
from coordinator.runtime.machine import Machine, MachineStopped, link_of
from coordinator.streaming.compensation import Compensation
from coordinator.streaming.move_source import MoveSource, Planned, ProgramOutput, Witness
from coordinator.streaming.pipeline import PlanRecord
from coordinator.streaming.standstill import StandstillTask
from coordinator.streaming.timed_events import Due, DueEvents
from coordinator.streaming.worker import MAKE_AHEAD_S, START_LEAD_S, Cycle, MotionWorker
from nodes.support.awake import Pause
from nodes.support.errors import CanductorError
from nodes.support.work_thread import WorkThread

CYCLE_S: Final = 0.05
FULL_CYCLE_S: Final = 1.2
"""While planner and commands reach as far ahead as they may; taken off the lead of MAKE_AHEAD_S."""
FULL_EARLY_S: Final = 0.1
"""So much earlier it comes when the loop is awake anyway."""
ALONE_EARLY_S: Final = 0.3
"""The same after a cycle that woke the loop itself: sensors report that often, and what comes with a report
once goes on to come with reports."""
BUSY_CYCLE_S: Final = 0.4
"""The same on a busy bus: that it cannot carry the plan has to be found in time."""
REST_CYCLE_S: Final = 1.0
"""At rest, where a cycle only steers the clocks of secondary nodes, predicted over a second."""
BUSY_START_LEAD_S: Final = 0.6
"""START_LEAD_S on a busy bus, where the first commands, dense as in every ramp, take longer."""
DELAY_MAX_S: Final = 0.5
"""More is not counted: a computer that is as slow all the time cannot print, since less lead is left between
two cycles."""
DELAY_FADE: Final = 0.8
"""How much of a delay still counts after each cycle that made commands."""
BUSY_LOAD: Final = 0.3
"""Share of a bus's time from which it counts as busy."""
SETTLE_S: Final = 0.05
"""After the last step is due, before it counts as done."""
CAUSE_WAIT_S: Final = 0.1


class Streamer:
    """Runs one JOB on MACHINE, whose nodes are READY.

    ON_OUTPUT gets replies and notices, ON_STATE the state of the planner in every cycle; ON_CYCLE ends each
    cycle. WITNESS sees moves and commands pass, COMPENSATION has the tables of the axes. AT_REST returns
    whether nobody waits for a cycle, unless ``call`` is called.
    """

    def __init__(
        self,
        machine: Machine,
        job: MoveSource,
        *,
        record: PlanRecord | None = None,
        witness: Witness | None = None,
        compensation: "Compensation | None" = None,
        on_output: Callable[[ProgramOutput], None],
        on_state: Callable[[Planned], None],
        on_cycle: Callable[[], None] = lambda: None,
        at_rest: Callable[[], bool] = lambda: False,
    ) -> None:
        self._machine = machine
        self.worker = MotionWorker(machine, job, record=record, witness=witness, compensation=compensation)
        """For others to look at from the control loop, not to call."""
        self._job = job
        self._on_output = on_output
        self._on_state = on_state
        self._on_cycle = on_cycle
        self._at_rest = at_rest
        self._called = False
        """Since the cycle at hand began."""
        self._rested = False
        """Whether the cycle at hand comes after a rest in which nothing has come up."""
        self._delay_s = 0.0
        """How long cycles have lately taken at most until their commands were handed over: motion on a slow
        computer needs as much more lead."""
        self._busy = False
        """Whether a bus is busy, as of the last cycle."""
        self._doubtful = False
        """Whether a bus may not carry what is queued on it in time."""
        self._pause = Pause()
        """Between two cycles."""
        self._alone = False
        """Whether nothing else was to be done when the last pause ended."""
        self.cycles = 0
        """So far."""
        self._witness = witness
        self._nodes = machine.moving
        if compensation is not None:
            compensation.on_want = self.call
        self._due = DueEvents()
        self.began_s = 0.0
        """Print time at which the job began, or went on after something else had moved the machine."""
        self.ended_s = 0.0
        self._standstill: StandstillTask | None = None

    def print_time_now(self) -> float:
        """Return the present print time."""
        return self.worker.print_time_now()

    @property
    def executed_s(self) -> float:
        """Return for how long the machine has moved since ``began_s``, in s of print time."""
        now = self.print_time_now()
        return max(0.0, min(now, self.worker.pipeline.appended_until) - self.began_s)

    def hold(self, cause: str) -> None:
        """Hold the g-code, from the control loop: what is planned is carried out, to a standstill.

        CAUSE is a sentence. The end of a job that has been read to its end is not held up.
        """
        self.worker.held = cause
        self.call()

    def release(self) -> None:
        """Resume the g-code after ``hold``."""
        self.worker.held = None
        self.call()

    def call(self) -> None:
        """Begin the next cycle at once, from the control loop: there is something new to do."""
        self._called = True
        self._pause.end()

    @property
    def held(self) -> str | None:
        """Why the g-code waits, or None."""
        return self.worker.held

    async def run(self) -> None:
        """Run the job to its end: until the last step is executed.

        Raises MachineStopped when the machine stops meanwhile, CanductorError when the job or a link fails;
        the machine is stopped then.
        """
        self.worker.began_at = await self._machine.query_stepper_counts()
        self._set_start_lead()
        self.began_s = self.worker.begin()
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
            if self._standstill is not None:
                await self._standstill.close()

    async def _stop_after(self, error: BaseException | None, watch: asyncio.Future[MachineStopped]) -> None:
        """Stop the machine after ERROR of the stream."""
        # The link may have failed a moment before its node is known to be lost: that is the better cause.
        # Meanwhile a bus that carries too little would make the first step late.
        if not isinstance(error, BusOverload):
            await asyncio.wait((watch,), timeout=CAUSE_WAIT_S)
        self._machine.stop(f"{error}; all nodes were stopped")
        await watch

    # ------------------------------------------------------------------------------------------- streaming

    async def _stream(self) -> None:
        async with WorkThread("motion") as thread:
            event: Event | None = None
            while not isinstance(event, End):
                self._called = False
                self.cycles += 1
                began_s = self.print_time_now()
                rested, self._rested = self._rested, False
                if rested:  # nothing came: it is done sooner than two threads are woken
                    cycle = self.worker.work(event)
                else:
                    cycle = await thread.run(self.worker.work, event)
                event = cycle.event
                if isinstance(event, Emergency):
                    self._hand_over(cycle)
                    self._report_output(cycle)
                    self._machine.stop(f"{self._job.name}:{event.line}: M112 stopped the machine")
                    return
                self._report_cycle(cycle)
                self._hand_over(cycle)
                self._note_delay(cycle, self.print_time_now() - began_s)
                self._on_cycle()  # last: threads begin to write what it notes, and the loop rests
                if isinstance(event, StandstillAction):
                    await self._attend(event)
                if (event is not None and not cycle.more) or self.held is not None:
                    await self._pause_for(self._cycle_s(cycle))
            self.ended_s = self._job.planner.print_time_end_s
            await self._settle(thread)

    def _cycle_s(self, cycle: Cycle) -> float:
        """Return after which time the next cycle has something to do, unless somebody calls."""
        if self.held is not None or self._doubtful:
            return CYCLE_S
        ahead_s = self.worker.steps.generated_until - self.print_time_now()
        if isinstance(cycle.event, Full) and ahead_s > MAKE_AHEAD_S - CYCLE_S:
            return BUSY_CYCLE_S if self._busy else FULL_CYCLE_S
        if isinstance(cycle.event, StandstillAction) and self._standstill is not None:
            return REST_CYCLE_S
        stands_s = cycle.planned.stands_from_s
        if not isinstance(cycle.event, Idle) or stands_s is None or self._due.waiting:
            return CYCLE_S
        stands = self.print_time_now() >= stands_s + SETTLE_S
        return REST_CYCLE_S if stands and self._at_rest() else CYCLE_S

    async def _pause_for(self, pause_s: float) -> None:
        """Wait PAUSE_S, or until ``call``."""
        if self._called:
            return
        self._machine.let_reports_wait(rests=pause_s == REST_CYCLE_S and self._standstill is None)
        loop = asyncio.get_running_loop()
        ends_s = loop.time() + pause_s
        if pause_s == REST_CYCLE_S:  # together with the timers of modules
            ends_s = math.floor(ends_s / pause_s) * pause_s
        early_s = 0.0
        if pause_s == FULL_CYCLE_S:
            early_s = ALONE_EARLY_S if self._alone else FULL_EARLY_S
        await self._pause.between(ends_s - early_s, ends_s)
        self._alone = loop.time() >= ends_s
        self._rested = pause_s == REST_CYCLE_S and not self._called and self._at_rest()

    async def _attend(self, event: StandstillAction) -> None:
        """Perform EVENT once all moves before it are executed."""
        if self._standstill is None:
            if self.print_time_now() < event.print_time_s + self.worker.steps.lag_s + SETTLE_S:
                return
            self._standstill = StandstillTask(event)
            self._standstill.when_over(self.call)
        if self._standstill.look():
            self._standstill = None
            if event.moved:
                await self._begin_again()

    async def _begin_again(self) -> None:
        """Go on where something else has left the steppers."""
        began_at = await self._machine.query_stepper_counts()
        self._set_start_lead()
        self.began_s = self.worker.begin_again(began_at)

    def _hand_over(self, cycle: Cycle) -> None:
        if cycle.batches:
            self._machine.modules.before_motion(cycle.stepping)
        for node, batch in cycle.batches:
            link_of(self._nodes[node]).send_batch(batch)
        if cycle.batches and self._witness is not None:
            self._witness.see_sent(cycle.batches, cycle.planned)
        if cycle.batches or self._doubtful:
            self._doubtful = self._machine.check_load()

    def _report_output(self, cycle: Cycle) -> None:
        for output in cycle.output:
            self._on_output(output)
        self._act(self._due.take(self.print_time_now(), cycle.due))

    def _report_cycle(self, cycle: Cycle) -> None:
        self._report_output(cycle)
        self._on_state(cycle.planned)

    def _act(self, due: Sequence[Due]) -> None:
        for print_time_s, timed in due:
            try:
                timed.act(print_time_s)
            except CanductorError as error:  # such as the loss of a node that may be missing
                self._on_output(Notice(timed.line, f"{self._job.name}:{timed.line}: {error}"))

    def _note_delay(self, cycle: Cycle, delay_s: float) -> None:
        fade = DELAY_FADE if cycle.batches else 1.0
        self._delay_s = max(self._delay_s * fade, min(delay_s, DELAY_MAX_S))
        self._set_start_lead()

    def _set_start_lead(self) -> None:
        self._busy = self._machine.is_busy(BUSY_LOAD)
        self.worker.start_lead_s = (BUSY_START_LEAD_S if self._busy else START_LEAD_S) + self._delay_s

    async def _settle(self, thread: WorkThread) -> None:
        """Bring what is left to the nodes and wait until the last step is executed."""
        ends_s = self.ended_s + self.worker.steps.lag_s + SETTLE_S
        ended = False
        while not ended:
            ended = self.print_time_now() >= ends_s  # then once more, so that what ended last is reported
            cycle = await thread.run(self.worker.rest)
            self._hand_over(cycle)
            self._report_cycle(cycle)
            self._on_cycle()
            if not ended:
                await asyncio.sleep(CYCLE_S)
        self._act(self._due.rest())
        for node in self._nodes:
            await link_of(node).drained()

"""One ready life of the machine: the streamer that runs all along, and who waits for what it does."""

import asyncio
import contextlib
from collections.abc import Callable, Sequence
from typing import Final

from coordinator.gcode.events import Notice
from coordinator.gcode.status import MotionStatus
from coordinator.motion.planner.planner import Planner
from coordinator.runtime.machine import Machine
from coordinator.service.core.feeder import Feeder, QueuedWork
from coordinator.service.core.motion_lead import MotionLead
from coordinator.service.core.work import LinesWork, Work
from coordinator.service.state.toolpath import Toolpath
from coordinator.service.state.trace import FRESH_MAX, KEEP_S, Moment, MotionTrace
from coordinator.streaming.compensation import Compensation
from coordinator.streaming.move_source import Planned, ProgramOutput
from coordinator.streaming.pipeline import PlanRecord
from coordinator.streaming.program_machine import machine_state
from coordinator.streaming.streamer import Streamer

DWELL_S: Final = 2.0
"""A plan that reaches further ahead while nothing moves has a dwell; else it is only for the next move."""


class Motion:
    """Moves MACHINE, whose nodes are READY.

    ON_OUTPUT gets replies and notices. ON_PLANNED is called in every cycle before its commands are handed
    over, ON_CYCLE at its end. RECORD keeps all that is planned, for a proof. COMPENSATION has the tables of
    the axes. HAS_JOBS: whether programs control jobs; else the one that runs is all there is.
    """

    def __init__(
        self,
        machine: Machine,
        *,
        on_output: Callable[[ProgramOutput], None],
        on_cycle: Callable[[], None],
        on_planned: Callable[[], None] = lambda: None,
        record: PlanRecord | None = None,
        compensation: Compensation | None = None,
        has_jobs: bool = True,
    ) -> None:
        described = machine.description
        self.feeder = Feeder(
            Planner(described.limits),
            described.homed_position,
            machine_state(described, machine.modules.vocabulary),
            machine.modules.vocabulary,
            has_jobs=has_jobs,
        )
        self.trace = MotionTrace(len(machine.moving))
        self._toolpath = Toolpath()
        self.planned = Planned(MotionStatus.of(self.feeder.planner, self.feeder.machine), 0.0)
        self.lead = MotionLead()
        self.streamer = Streamer(
            machine,
            self.feeder,
            record=record,
            witness=self.trace,
            compensation=compensation,
            on_output=on_output,
            on_state=self._cycle_made,
            on_cycle=on_cycle,
            at_rest=self._at_rest,
        )
        self.feeder.on_call = self.streamer.call
        self.begun = asyncio.Event()
        """Set once ``planned`` is known, or never will be: a moment after the machine is ready."""
        self.moved = 0
        """Works so far that have moved anything."""
        self._ending: list[QueuedWork] = []
        self._waited_for: dict[QueuedWork, asyncio.Future[None]] = {}
        self._on_planned = on_planned

    async def run(self) -> None:
        """Move until ``finish``, or until the machine stops; raises as the streamer does."""
        try:
            await self.streamer.run()
        finally:
            self.begun.set()
            self.feeder.abandon()
            for done in self._waited_for.values():
                done.cancel()
            self._waited_for.clear()

    def finish(self) -> None:
        """End at the next standstill."""
        self.feeder.close()

    def finish_early(self) -> None:
        """End without another line of what is being done, or waits."""
        self.feeder.cancel_all()
        self.feeder.close()

    # ------------------------------------------------------------------------------------------- doing

    async def do(self, work: Work) -> QueuedWork:
        """Have WORK done and wait until it is, moves and all; its ``error`` is not raised.

        Cancelled, it ends the work before its next line. Raises FeederFull, MotionOver.
        """
        return await self._wait_for(self.feeder.submit(work))

    async def do_interjection(self, lines: LinesWork) -> QueuedWork:
        """Do the same for lines that may run while a job prints."""
        return await self._wait_for(self.feeder.submit_interjection(lines))

    async def _wait_for(self, queued: QueuedWork) -> QueuedWork:
        done = self._waited_for[queued] = asyncio.get_running_loop().create_future()
        try:
            await asyncio.wait((done,))
        finally:
            self._waited_for.pop(queued, None)
            self.feeder.cancel(queued)  # without effect on one that is done
        if done.cancelled():
            raise MotionOver
        return queued

    @property
    def standing(self) -> bool:
        """Whether nothing moves, and nothing planned will."""
        until = self.planned.stands_from_s
        return until is not None and self.now_s >= until

    @property
    def in_use(self) -> bool:
        """Whether anything moves or dwells, or lines that are no job's have moved something or wait."""
        now_s = self.now_s
        dwells = self.planned.state.print_time_end_s > now_s + DWELL_S
        return dwells or not self.standing or self.feeder.uses_machine(now_s)

    @property
    def paused(self) -> bool:
        """Whether a pause has reached its standstill; also one that a missing node caused."""
        return (self.feeder.paused or self.streamer.held is not None) and self.standing

    @property
    def now_s(self) -> float:
        """Print time."""
        return self.streamer.print_time_now()

    def moment(self) -> Moment:
        """Return where the machine is now, as its commands say."""
        now_s = self.now_s
        if self.standing:
            found = self.trace.at(now_s)
            return Moment(self.planned.state.toolhead_position, 0.0, found.line if found else 0, moving=False)
        return self.trace.at(now_s) or Moment(self.planned.state.toolhead_position, 0.0, 0, moving=False)

    @property
    def toolpath(self) -> Toolpath:
        """The path as planned so far."""
        self._toolpath.add(self.trace.take_fresh())
        return self._toolpath

    # ----------------------------------------------------------------------------------- cycle by cycle

    def _cycle_made(self, planned: Planned) -> None:
        self.planned = planned
        self.begun.set()
        now_s = self.now_s
        comes_to_rest = planned.stands_from_s is not None
        self.lead.look(now_s, self.streamer.worker.steps.generated_until, comes_to_rest=comes_to_rest)
        self.trace.forget_before_s = now_s - KEEP_S
        if self.trace.fresh_batches > FRESH_MAX // 4:
            self._toolpath.add(self.trace.take_fresh())
        with contextlib.suppress(IndexError):
            while True:
                self._ending.append(self.feeder.finished.popleft())
        self._ending = [queued for queued in self._ending if not self._settle(queued, now_s)]
        self._on_planned()

    def _at_rest(self) -> bool:
        """Return whether nothing is left to be done or reported."""
        return not (self.feeder.has_work or self._ending)

    def _settle(self, queued: QueuedWork, now_s: float) -> bool:
        """Report QUEUED done once its last move is executed; return whether it is."""
        assert queued.ends_at_s is not None
        if now_s < queued.ends_at_s + self.streamer.worker.steps.lag_s and queued.ends_at_s:
            return False
        queued.done = True
        self.moved += queued.moved
        done = self._waited_for.get(queued)
        if done is not None and not done.done():
            done.set_result(None)
        return True


class MotionOver(Exception):  # noqa: N818 (it ended, for whatever reason; its owner knows which)
    """Motion ended: the machine stopped or restarts."""


def texts(output: Sequence[ProgramOutput]) -> tuple[list[str], list[str]]:
    """Return the texts of replies and of notices."""
    notices = [event.text for event in output if isinstance(event, Notice)]
    return [event.text for event in output if not isinstance(event, Notice)], notices

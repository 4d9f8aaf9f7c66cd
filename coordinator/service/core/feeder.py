"""Feeds the streamer with what clients want done: one work after the other, for as long as the machine lives.

While a job is paused, other works come between two of its lines; afterwards it goes on where it was.

Two threads meet here. The control loop submits, pauses and cancels; the motion worker calls ``step``. What
passes between them are single attributes and deques, whose operations are atomic; nobody waits for anybody.
"""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

from coordinator.gcode.builtins.state import come_back, present_state
from coordinator.gcode.commands import NO_WORDS, ProgramContext, Recovering, Vocabulary
from coordinator.gcode.events import (
    AS_SOON_AS_POSSIBLE,
    Emergency,
    End,
    Event,
    Full,
    Idle,
    Notice,
    Progress,
    Reply,
    StandstillAction,
    Timed,
)
from coordinator.gcode.machine_state import MachineState, SavedState
from coordinator.motion.planner.language import SuspendedProgram
from coordinator.motion.planner.planner import Planner
from coordinator.service.core.work import NO_PROGRESS, LinesWork, Rest, Setting, Work
from nodes.support.errors import CanductorError

WAITING_MAX: Final = 64
"""Works that may wait; more are refused."""
INTERJECTIONS_MAX: Final = 16
WAIT_S: Final = 1.0
"""Lines that stand still for longer wait for something; what only asks a node is over by then."""
COME_BACK_MM_S: Final = 50.0
"""At which a job goes back to where it was paused."""
OUTPUT_MAX: Final = 1000
"""Replies and notices that are kept of one work."""
OUTPUT_CHARS_MAX: Final = 262_144
"""Of these together; the one that reaches it is the last one."""


class FeederFull(CanductorError):  # noqa: N818
    """Too much waits already."""


@dataclass(eq=False)
class QueuedWork:
    """A work on its way."""

    work: Work
    is_job: bool = False
    output: list[Reply | Notice] = field(default_factory=list)
    output_chars: int = 0
    progress: Progress = NO_PROGRESS
    """How far it is read."""
    cancelled: bool = False
    error: CanductorError | None = None
    """Why it ended before its end."""
    begun_at_s: float | None = None
    """Print time up to which all was planned when it began; None: it waits."""
    moves_before: int = 0
    """The planner's moves when it began."""
    moved: bool = False
    """Whether it has moved anything so far."""
    read: bool = False
    """Whether nothing more of it will be planned."""
    ends_at_s: float | None = None
    """Print time at which its last move ends, once it is known; 0: there is nothing to wait for."""
    done: bool = False
    """Whether that has passed."""
    standstill: StandstillAction | None = None
    """What it waits for while the machine stands."""


class Feeder:
    """A ``MoveSource`` that never ends until ``close``: idles while nothing is to do."""

    def __init__(
        self,
        planner: Planner,
        homed_position: Mapping[str, float],
        machine: MachineState,
        vocabulary: Vocabulary = NO_WORDS,
        *,
        has_jobs: bool = True,
    ) -> None:
        self.planner = planner
        self.machine = machine
        prints = self if has_jobs else None
        self._setting = Setting(planner, machine, dict(homed_position), vocabulary, prints)
        self._name = "nothing"
        self._waiting: deque[QueuedWork] = deque()
        self._interjections: deque[QueuedWork] = deque()
        self._interjection: QueuedWork | None = None
        """That is being done, and goes on later."""
        self._interjection_place: SuspendedProgram | None = None
        """Where it goes on."""
        self._interjection_events: deque[Event] = deque()
        self._now: QueuedWork | None = None
        self._held: tuple[QueuedWork, SuspendedProgram] | None = None
        """A paused job that others have come between."""
        self._come_back: SavedState | None = None
        """Where the paused job has to go on, if something may have moved since."""
        self._paused = False
        self._pause_wanted = False
        self._cancel_wanted = False
        self._closed = False
        self.on_call: Callable[[], None] = lambda: None
        """Called on the control loop whenever ``step`` may have something to do that it had not before."""
        self.to_recover: deque[Recovering] = deque(maxlen=1)
        """For the control loop to take: a program wants the interrupted job to go on."""
        self.to_print: deque[str] = deque(maxlen=WAITING_MAX)
        """For the control loop to take: files that programs want to have printed."""
        self.finished: deque[QueuedWork] = deque(maxlen=WAITING_MAX + INTERJECTIONS_MAX + 1)
        """For the control loop to take: works of which everything is read, oldest first."""

    # --------------------------------------------------------------------------- for the control loop

    @property
    def name(self) -> str:
        """What is being read, or was read last."""
        return self._name

    @property
    def line(self) -> int:
        """Number of the line that comes next."""
        return self.planner.lines + 1

    @property
    def busy(self) -> bool:
        """Whether anything is being done or waits."""
        return self._now is not None or self._held is not None or bool(self._waiting)

    @property
    def has_work(self) -> bool:
        """Whether ``step`` has anything to do, or its results wait to be taken."""
        interjections = self._interjections or self._interjection or self._interjection_events
        return bool(self.busy or interjections or self.finished or self._closed)

    def uses_machine(self, now_s: float) -> bool:
        """Whether lines, not a job, have moved something or wait at standstill, at print time NOW_S."""
        now = self._now
        if now is None or now.is_job:
            return False
        standstill = now.standstill
        return now.moved or (standstill is not None and now_s >= standstill.print_time_s + WAIT_S)

    @property
    def paused(self) -> bool:
        """Whether works wait."""
        return self._paused

    @property
    def axes(self) -> str:
        """Letters of the axes that G28 homes."""
        return "".join(self._setting.homed_position)

    @property
    def vocabulary(self) -> Vocabulary:
        """What programs know through modules."""
        return self._setting.vocabulary

    def submit(self, work: Work, *, is_job: bool = False) -> QueuedWork:
        """Have WORK done after all that was submitted before; raises FeederFull."""
        if len(self._waiting) >= WAITING_MAX:
            raise FeederFull(f"{WAITING_MAX} requests wait for the machine already; wait for their answers")
        queued = QueuedWork(work, is_job)
        self._waiting.append(queued)
        self.on_call()
        return queued

    def submit_interjection(self, lines: LinesWork) -> QueuedWork:
        """Have LINES, none of which moves anything, done between two lines of the work; raises FeederFull."""
        if len(self._interjections) >= INTERJECTIONS_MAX:
            raise FeederFull(f"{INTERJECTIONS_MAX} requests wait already; wait for their answers")
        queued = QueuedWork(lines)
        self._interjections.append(queued)
        self.on_call()
        return queued

    def pause(self) -> None:
        """Read no further: what is planned is carried out, to a standstill between two moves."""
        self._paused = True
        self.on_call()

    def resume(self) -> None:
        """Go on with the next line."""
        self._paused = False
        self.on_call()

    def cancel(self, queued: QueuedWork) -> None:
        """End QUEUED before its next line, also while it waits; what is planned of it is carried out."""
        queued.cancelled = True
        if (standstill := queued.standstill) is not None:
            standstill.cancelled = True
        if not queued.done:
            self.on_call()

    def cancel_all(self) -> None:
        """End what is being done and what waits, each before its next line."""
        for queued in (*self._waiting, *self._interjections, self._now, self._interjection):
            if queued is not None:
                self.cancel(queued)

    def close(self) -> None:
        """End: ``step`` answers End once all is planned."""
        self._closed = True
        self.on_call()

    def abandon(self) -> None:
        """Release what works hold that will not be done any more; the worker has ended."""
        left = [*self._waiting, *([self._now] if self._now is not None else [])]
        left += [self._held[0]] if self._held is not None else []
        self._waiting.clear()
        self._interjections.clear()
        self._now = self._held = None
        for queued in left:
            queued.work.close()

    # ------------------------------------------------------------------------- for the worker's thread

    def step(self) -> Event:
        """Go on with the work at hand, or the next one."""
        if (event := self._do_interjections()) is not None:
            return event
        if self._now is None and (event := self._take_next()) is not None:
            return event
        queued = self._now
        assert queued is not None
        self._name = queued.work.name
        if queued.read or queued.cancelled:
            return self._finish(queued)
        if self._gives_way(queued):
            self._held = (queued, self.planner.suspend_program())
            self._now = None
            return queued.progress
        try:
            event = self._step_job(queued) if queued.is_job else self._begin_or_step(queued)
        except CanductorError as error:
            queued.error = error
            queued.read = True
            return self._finish(queued)
        return self._pass_on(queued, event)

    def attend_others(self) -> Event | None:
        """Act on lines of clients while the work at hand waits for something that is done at rest."""
        until_s, self.planner.plan_until_s = self.planner.plan_until_s, float("-inf")
        event = self._do_interjections()
        self.planner.plan_until_s = until_s
        return None if isinstance(event, Full) else event

    def _take_next(self) -> Event | None:
        if self._waiting:
            self._now = self._waiting.popleft()
        elif self._held is not None and (not self._paused or self._held[0].cancelled):
            (self._now, suspended), self._held = self._held, None
            self.planner.resume_program(suspended)
        elif self._held is None and self._closed:
            return End(0, self.planner.print_time_end_s) if self.planner.flush() else Full()
        else:
            return Idle()
        return None

    def _gives_way(self, queued: QueuedWork) -> bool:
        """Whether QUEUED is a paused job that others may come between now; remember where it stands."""
        if not (self._paused and queued.is_job and self._waiting) or not queued.work.settled:
            return False
        if self._come_back is None and queued.begun_at_s is not None:
            self._come_back = present_state(self.planner)
        return True

    def _step_job(self, queued: QueuedWork) -> Event:
        """Go on with a job, unless it is paused; raises CanductorError."""
        if not self._paused:
            if self._come_back is not None and (event := self._go_back(self._come_back)) is not None:
                return event
            return self._begin_or_step(queued)
        if queued.begun_at_s is not None and (event := queued.work.pending()) is not None:
            return event
        return Idle()

    def _go_back(self, saved: SavedState) -> Event | None:
        """Go where the job was when it was paused; None when that is done."""
        lost = [axis for axis in saved.homed if axis not in self.planner.homed]
        problem, done = "", False
        suspended = self.planner.suspend_program()
        try:
            done = not lost and come_back(self.planner, saved, COME_BACK_MM_S)
        except ValueError as error:
            problem = str(error)
        self.planner.resume_program(suspended)
        if lost:
            problem = f"{' and '.join(lost)} must be homed with G28 before it can go on"
        if problem:
            self._paused = True
            return Notice(self.line, f"{self.name} stays paused: {problem}")
        if not done:
            return Full()
        self._come_back = None
        return None

    def _begin_or_step(self, queued: QueuedWork) -> Event:
        if queued.begun_at_s is None:
            queued.begun_at_s = self.planner.print_time_end_s
            queued.moves_before = self.planner.moves
            queued.work.begin(self._setting)
        standstill, queued.standstill = queued.standstill, None
        if standstill is not None and standstill.done is not None:
            queued.moved = queued.moved or standstill.done.moved
        try:
            return queued.work.step()
        finally:
            queued.moved = queued.moved or self.planner.moves != queued.moves_before

    def _pass_on(self, queued: QueuedWork, event: Event) -> Event:
        """Keep what is the client's, hand on what is the streamer's."""
        if isinstance(event, End):
            queued.read = True
            return self._finish(queued)
        queued.progress = queued.work.progress()
        if queued.is_job and queued.work.at_line:
            self._paused, self._pause_wanted = self._paused or self._pause_wanted, False
            queued.cancelled, self._cancel_wanted = queued.cancelled or self._cancel_wanted, False
        if isinstance(event, StandstillAction):
            queued.standstill = event
            event.cancelled = queued.cancelled  # since the last look
        if isinstance(event, Reply | Notice):
            _keep(queued, event)
        return event

    def _finish(self, queued: QueuedWork) -> Event:
        """Let QUEUED go once its moves are planned as far as they have to be."""
        early = queued.cancelled or queued.error is not None
        if queued.standstill is not None and queued.standstill.moved:
            self.planner.homed = ""  # its position is not taken over any more
        if (early or queued.work.rest is Rest.STANDSTILL) and not self.planner.flush():
            return Full()
        queued.read = True
        end_s = self.planner.print_time_end_s
        at_once = end_s == queued.begun_at_s or (queued.work.rest is Rest.OPEN and not early)
        queued.ends_at_s = 0.0 if at_once else end_s
        queued.work.close()
        self._now = None
        if queued.is_job:
            self._come_back, self._pause_wanted, self._cancel_wanted = None, False, False
        self.finished.append(queued)
        return queued.progress

    def _do_interjections(self) -> Event | None:
        """Execute some lines that neither move nor wait, return their events one by one.

        Full: one needs room; Progress: there are more lines.
        """
        while not self._interjection_events and (self._interjection is not None or self._interjections):
            queued = self._interjection = self._interjection or self._interjections.popleft()
            suspended = self.planner.suspend_program(moving=False)
            if self._interjection_place is not None:
                self.planner.resume_program(self._interjection_place)
            left = self._do_interjection(queued)
            self._interjection_place = None if left is None else self.planner.suspend_program(moving=False)
            self.planner.resume_program(suspended)
            if left is not None:
                return left
            self._interjection = None
        return self._interjection_events.popleft() if self._interjection_events else None

    def _do_interjection(self, queued: QueuedWork) -> Full | Progress | None:
        """Go on with lines of a client by one step; Full: there is no room; Progress: there are more."""
        try:
            if queued.begun_at_s is None:
                queued.begun_at_s = self.planner.print_time_end_s
                queued.work.begin(self._setting)
            self._name = queued.work.name
            event = End(0, 0.0) if queued.cancelled else queued.work.step()
            if isinstance(event, Full):
                return event
            if isinstance(event, Reply | Notice):
                _keep(queued, event)
            elif isinstance(event, Timed):  # it does not belong to any place among the work's moves
                self._interjection_events.append(replace(event, after_moves=AS_SOON_AS_POSSIBLE))
            elif isinstance(event, Emergency):
                self._interjection_events.appendleft(event)
            if not isinstance(event, End | Emergency):
                return queued.work.progress()
        except CanductorError as error:
            queued.error = error
        queued.read = True
        queued.ends_at_s = 0.0
        self.finished.append(queued)
        return None

    # ------------------------------------------------- for programs (PrintControl)

    @property
    def job_is_active(self) -> bool:
        """Whether there is a job that is neither done nor cancelled."""
        found = (self._now, self._held[0] if self._held is not None else None)
        return any(queued is not None and queued.is_job and not queued.cancelled for queued in found)

    def pause_job(self, program: ProgramContext) -> None:
        """Let the job read no further, by a line of PROGRAM."""
        if not self.job_is_active:
            return
        if self._come_back is None:
            self._come_back = present_state(self.planner)
        if self._is_job(program):
            self._pause_wanted = True
            program.break_after_line()
        else:
            self._paused = True

    def come_back(self, program: ProgramContext, speed_mm_s: float) -> bool:  # noqa: ARG002 (whose moves it is)
        """Go to where the job was paused."""
        return self._come_back is None or come_back(self.planner, self._come_back, speed_mm_s)

    def resume_job(self) -> None:
        """Let the job go on when the program at hand has ended."""
        self._paused = self._pause_wanted = False

    def cancel_job(self, program: ProgramContext) -> None:
        """End the job, by a line of PROGRAM."""
        if self._is_job(program):
            self._cancel_wanted = True
            program.break_after_line()
        elif self._held is not None:
            self._held[0].cancelled = True
        elif self._now is not None and self._now.is_job:
            self.cancel(self._now)

    def start_job(self, name: str) -> None:
        """Have the file NAME printed next."""
        self.to_print.append(name)

    def recover_job(self, how: Recovering) -> None:
        """Have the interrupted job go on."""
        self.to_recover.append(how)

    def _is_job(self, program: ProgramContext) -> bool:
        now = self._now
        return now is not None and now.is_job and not program.while_printing and self._interjection is None


def _keep(queued: QueuedWork, event: Reply | Notice) -> None:
    if len(queued.output) < OUTPUT_MAX and queued.output_chars < OUTPUT_CHARS_MAX:
        queued.output.append(event)
        queued.output_chars += len(event.text)

"""Feeds the streamer with what clients want done: one work after the other, for as long as the machine lives.

Two threads meet here. The control loop submits, pauses and cancels; the motion worker calls ``step``. What
passes between them are single attributes and deques, whose operations are atomic; nobody waits for anybody.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

from coordinator.gcode.commands import NO_WORDS, Vocabulary
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
    Resting,
    Timed,
)
from coordinator.gcode.machine_state import MachineState
from coordinator.motion.planner import Planner
from coordinator.service.work import NO_PROGRESS, LinesWork, Rest, Setting, Work
from nodes.errors import CanductorError

WAITING_MAX: Final = 64
"""Works that may wait; more are refused."""
ASIDES_MAX: Final = 16
TOLD_MAX: Final = 1000
"""Replies and notices that are kept of one work."""


class FeederFull(CanductorError):  # noqa: N818
    """Too much waits already."""


@dataclass(eq=False)
class Ticket:
    """A work on its way."""

    work: Work
    is_job: bool = False
    told: list[Reply | Notice] = field(default_factory=list)
    progress: Progress = NO_PROGRESS
    """How far it is read."""
    cancelled: bool = False
    error: CanductorError | None = None
    """Why it ended before its end."""
    begun_at_s: float | None = None
    """Print time up to which all was planned when it began; None: it waits."""
    read: bool = False
    """Whether nothing more of it will be planned."""
    ends_at_s: float | None = None
    """Print time at which its last move ends, once it is known; 0: there is nothing to wait for."""
    done: bool = False
    """Whether that has passed."""
    resting: Resting | None = None
    """What it waits for while the machine stands."""


class Feeder:
    """A ``MoveSource`` that never ends until ``close``: idles while nothing is to do."""

    def __init__(
        self,
        planner: Planner,
        homed_position: Mapping[str, float],
        machine: MachineState,
        vocabulary: Vocabulary = NO_WORDS,
    ) -> None:
        self.planner = planner
        self.machine = machine
        self._setting = Setting(planner, machine, dict(homed_position), vocabulary)
        self._waiting: deque[Ticket] = deque()
        self._asides: deque[Ticket] = deque()
        self._aside_events: deque[Event] = deque()
        self._now: Ticket | None = None
        self._paused = False
        self._closed = False
        self.finished: deque[Ticket] = deque(maxlen=WAITING_MAX + ASIDES_MAX + 1)
        """For the control loop to take: tickets of which everything is read, oldest first."""

    # --------------------------------------------------------------------------- for the control loop

    @property
    def name(self) -> str:
        """What is being read."""
        now = self._now
        return now.work.name if now is not None else "nothing"

    @property
    def line(self) -> int:
        """Number of the line that comes next."""
        return self.planner.lines + 1

    @property
    def busy(self) -> bool:
        """Whether anything is being done or waits."""
        return self._now is not None or bool(self._waiting)

    @property
    def paused(self) -> bool:
        """Whether works wait."""
        return self._paused

    def submit(self, work: Work, *, is_job: bool = False) -> Ticket:
        """Have WORK done after all that was submitted before; raises FeederFull."""
        if len(self._waiting) >= WAITING_MAX:
            raise FeederFull(f"{WAITING_MAX} requests wait for the machine already; wait for their answers")
        ticket = Ticket(work, is_job)
        self._waiting.append(ticket)
        return ticket

    def submit_aside(self, lines: LinesWork) -> Ticket:
        """Have LINES, none of which moves anything, done between two lines of the work; raises FeederFull."""
        if len(self._asides) >= ASIDES_MAX:
            raise FeederFull(f"{ASIDES_MAX} requests wait already; wait for their answers")
        ticket = Ticket(lines)
        self._asides.append(ticket)
        return ticket

    def pause(self) -> None:
        """Read no further: what is planned is carried out, to a standstill between two moves."""
        self._paused = True

    def resume(self) -> None:
        """Go on with the next line."""
        self._paused = False

    def cancel(self, ticket: Ticket) -> None:
        """End TICKET before its next line, also while it waits; what is planned of it is carried out."""
        ticket.cancelled = True
        if (resting := ticket.resting) is not None:
            resting.cancelled = True

    def cancel_all(self) -> None:
        """End what is being done and what waits, each before its next line."""
        now = self._now
        for ticket in (*self._waiting, *([now] if now is not None else [])):
            self.cancel(ticket)

    def close(self) -> None:
        """End: ``step`` answers End once all is planned."""
        self._closed = True

    def abandon(self) -> None:
        """Release what works hold that will not be done any more; the worker has ended."""
        left = [*self._waiting, *([self._now] if self._now is not None else [])]
        self._waiting.clear()
        self._asides.clear()
        self._now = None
        for ticket in left:
            ticket.work.close()

    # ------------------------------------------------------------------------- for the worker's thread

    def step(self) -> Event:
        """Go on with the work at hand, or the next one."""
        while self._asides:
            self._do_aside(self._asides.popleft())
        if self._aside_events:
            return self._aside_events.popleft()
        if self._now is None and (event := self._take_next()) is not None:
            return event
        ticket = self._now
        assert ticket is not None
        if ticket.read or ticket.cancelled:
            return self._finish(ticket)
        if self._paused:
            return Idle()
        try:
            event = self._begin_or_step(ticket)
        except CanductorError as error:
            ticket.error = error
            ticket.read = True
            return self._finish(ticket)
        return self._pass_on(ticket, event)

    def _take_next(self) -> Event | None:
        if self._closed:
            return End(0, self.planner.print_time_end_s) if self.planner.flush() else Full()
        if not self._waiting:
            return Idle()
        self._now = self._waiting.popleft()
        return None

    def _begin_or_step(self, ticket: Ticket) -> Event:
        if ticket.begun_at_s is None:
            ticket.begun_at_s = self.planner.print_time_end_s
            ticket.work.begin(self._setting)
        ticket.resting = None
        return ticket.work.step()

    def _pass_on(self, ticket: Ticket, event: Event) -> Event:
        """Keep what is the client's, hand on what is the streamer's."""
        if isinstance(event, End):
            ticket.read = True
            return self._finish(ticket)
        ticket.progress = ticket.work.progress()
        if isinstance(event, Resting):
            ticket.resting = event
            event.cancelled = ticket.cancelled  # since the last look
        if isinstance(event, Reply | Notice):
            _keep(ticket, event)
        return event

    def _finish(self, ticket: Ticket) -> Event:
        """Let TICKET go once its moves are planned as far as they have to be."""
        early = ticket.cancelled or ticket.error is not None
        if ticket.resting is not None and ticket.resting.moved:
            self.planner.homed = ""  # nobody takes over any more where that left the machine
        if (early or ticket.work.rest is Rest.STANDSTILL) and not self.planner.flush():
            return Full()
        ticket.read = True
        end_s = self.planner.print_time_end_s
        at_once = end_s == ticket.begun_at_s or (ticket.work.rest is Rest.OPEN and not early)
        ticket.ends_at_s = 0.0 if at_once else end_s
        ticket.work.close()
        self._now = None
        self.finished.append(ticket)
        return ticket.progress

    def _do_aside(self, ticket: Ticket) -> None:
        """Act on lines that neither move nor wait, and leave the work's own count of lines as it was."""
        lines = self.planner.lines
        try:
            ticket.work.begin(self._setting)
            while not isinstance(event := ticket.work.step(), End | Emergency):
                if isinstance(event, Reply | Notice):
                    _keep(ticket, event)
                elif isinstance(event, Timed):  # it does not belong to any place among the work's moves
                    self._aside_events.append(replace(event, after_moves=AS_SOON_AS_POSSIBLE))
            if isinstance(event, Emergency):
                self._aside_events.appendleft(event)
        except CanductorError as error:
            ticket.error = error
        self.planner.lines = lines
        ticket.read = True
        ticket.ends_at_s = 0.0
        self.finished.append(ticket)


def _keep(ticket: Ticket, event: Reply | Notice) -> None:
    if len(ticket.told) < TOLD_MAX:
        ticket.told.append(event)

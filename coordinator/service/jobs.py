"""The job of a machine: one file at a time, from its start to whatever became of it."""

from enum import StrEnum

from coordinator.service.feeder import Feeder, Ticket
from coordinator.service.motion import Motion
from coordinator.service.work import FileWork


class JobPhase(StrEnum):
    """How far a job is."""

    NONE = "none"
    PRINTING = "printing"
    PAUSING = "pausing"
    """What is planned is still carried out."""
    PAUSED = "paused"
    CANCELLING = "cancelling"
    DONE = "done"
    CANCELLED = "cancelled"
    FAILED = "failed"
    """A line could not be carried out; what came before it was, and the machine is ready."""
    STOPPED = "stopped"
    """The machine stopped."""


ACTIVE = frozenset((JobPhase.PRINTING, JobPhase.PAUSING, JobPhase.PAUSED, JobPhase.CANCELLING))


class JobRun:
    """One file on its way through MOTION; ``look`` as often as is handy."""

    def __init__(self, motion: Motion, work: FileWork, now_s: float) -> None:
        self.file = work.name
        self.size_bytes = work.program.size_bytes or 0
        self.phase = JobPhase.PRINTING
        self.message = ""
        """Why it failed or stopped."""
        self.began_s = now_s
        self.ended_s: float | None = None
        self.print_time_s = 0.0
        """For which it has moved, pauses left out."""
        self.line = 0
        """Being carried out."""
        self._looked_s = now_s
        self._motion = motion
        self._ticket: Ticket = motion.feeder.submit(work, is_job=True)

    @property
    def active(self) -> bool:
        """Whether it is on its way."""
        return self.phase in ACTIVE

    @property
    def lines_read(self) -> int:
        """Lines read; they are carried out seconds later."""
        return self._ticket.progress.line

    @property
    def done_bytes(self) -> int:
        """Bytes read."""
        if self.phase is JobPhase.DONE:
            return self.size_bytes
        return self._ticket.progress.done_bytes

    @property
    def progress(self) -> float:
        """The part that is read, 0..1."""
        return min(1.0, self.done_bytes / self.size_bytes) if self.size_bytes else 0.0

    def pause(self) -> None:
        """Come to a standstill between two moves."""
        self._feeder.pause()
        if self.phase is JobPhase.PRINTING:
            self.phase = JobPhase.PAUSING

    def resume(self) -> None:
        """Go on where it was."""
        self._feeder.resume()
        if self.phase in (JobPhase.PAUSING, JobPhase.PAUSED):
            self.phase = JobPhase.PRINTING

    def cancel(self) -> None:
        """End early: what is planned is carried out."""
        self._feeder.cancel(self._ticket)
        self._feeder.resume()
        self.phase = JobPhase.CANCELLING

    def stop(self, message: str, now_s: float) -> None:
        """Take note that the machine stopped."""
        if self.active:
            self._end(JobPhase.STOPPED, message, now_s)

    def look(self, now_s: float) -> None:
        """Take note of how far it is at NOW_S, any clock in s."""
        if not self.active:
            return
        if not self._motion.paused:
            self.print_time_s += now_s - self._looked_s
        self._looked_s = now_s
        moment = self._motion.moment()
        began_s = self._ticket.begun_at_s
        if moment.moving and moment.line and began_s is not None and self._motion.now_s >= began_s:
            self.line = moment.line
        ticket = self._ticket
        if ticket.done:
            self._ended(ticket, now_s)
        elif self.phase is JobPhase.PAUSING and self._motion.paused:
            self.phase = JobPhase.PAUSED

    def _ended(self, ticket: Ticket, now_s: float) -> None:
        self._feeder.resume()  # a pause that came too late must not hold what comes next
        if ticket.error is not None:
            self._end(JobPhase.FAILED, str(ticket.error), now_s)
        elif ticket.cancelled:
            self._end(JobPhase.CANCELLED, "", now_s)
        else:
            self._end(JobPhase.DONE, "", now_s)

    def _end(self, phase: JobPhase, message: str, now_s: float) -> None:
        self.phase, self.message, self.ended_s = phase, message, now_s

    @property
    def _feeder(self) -> Feeder:
        return self._motion.feeder

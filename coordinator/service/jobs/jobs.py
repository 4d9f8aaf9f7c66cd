"""The job of a machine: one file at a time, from its start to its end."""

from enum import StrEnum

from coordinator.gcode.events import Progress
from coordinator.service.core.feeder import Feeder, QueuedWork
from coordinator.service.core.motion import Motion
from coordinator.service.core.work import FileWork
from coordinator.service.jobs.file_places import FilePlaces
from nodes.support.errors import CanductorError


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
    """One file that MOTION prints; call ``look`` in every cycle."""

    def __init__(self, motion: Motion, work: FileWork, now_s: float) -> None:
        self.file = work.name
        self.size_bytes = work.program.size_bytes or 0
        """Of one that is fed: 0, until it is done."""
        self.lines_fed: int | None = None
        """Lines that came so far; None: it is a file."""
        self.phase = JobPhase.PRINTING
        self.message = ""
        """Why it failed or stopped."""
        self.began_s = now_s
        self.ended_s: float | None = None
        self.print_time_s = 0.0
        """For which it has moved, pauses left out."""
        self.print_duration_s = 0.0
        """The same from the first extrusion on."""
        self.line = 0
        """Being carried out."""
        self.filament_mm = 0.0
        """Of the extruder, drawn in since the begin."""
        self._extruded = False
        self._done_bytes = 0
        self._places = FilePlaces()
        program = work.program
        self._places.add(program.data[program.start :], program.done_bytes)
        program.on_piece = self._places.add
        self._looked_s = now_s
        self._began_e = motion.moment().position[3]
        self._motion = motion
        self._queued: QueuedWork = motion.feeder.submit(work, is_job=True)

    @property
    def active(self) -> bool:
        """Whether it is on its way."""
        return self.phase in ACTIVE

    @property
    def error(self) -> CanductorError | None:
        """Why it ended before its last line; None: it did not."""
        return self._queued.error

    @property
    def gives_way(self) -> bool:
        """Whether others may move between two of its lines."""
        return self.phase in (JobPhase.PAUSING, JobPhase.PAUSED) and self._feeder.paused

    @property
    def lines_read(self) -> int:
        """Lines read; they are carried out seconds later."""
        return self._queued.progress.line

    @property
    def read_bytes(self) -> int:
        """Bytes read."""
        return self.size_bytes if self.phase is JobPhase.DONE else self._queued.progress.done_bytes

    @property
    def done_bytes(self) -> int:
        """Bytes carried out."""
        return self.size_bytes if self.phase is JobPhase.DONE else self._done_bytes

    @property
    def progress(self) -> float:
        """The part that is carried out, 0..1."""
        if self.size_bytes:
            return min(1.0, self.done_bytes / self.size_bytes)
        return 1.0 if self.phase is JobPhase.DONE else 0.0

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
        self._feeder.cancel(self._queued)
        self._feeder.resume()
        self.phase = JobPhase.CANCELLING

    def stop(self, message: str, now_s: float) -> None:
        """Record that the machine stopped."""
        if self.active:
            self._end(JobPhase.STOPPED, message, now_s)

    def look(self, now_s: float) -> None:
        """Record the progress at NOW_S, any clock in s."""
        if not self.active:
            return
        self._follow_programs()
        moment = self._motion.moment()
        began_s = self._queued.begun_at_s
        self.filament_mm = moment.position[3] - self._began_e
        self._extruded = self._extruded or self.filament_mm > 0
        if self.phase is not JobPhase.PAUSED and not self._motion.paused:
            passed_s = now_s - self._looked_s
            self.print_time_s += passed_s
            self.print_duration_s += passed_s if self._extruded else 0.0
        self._looked_s = now_s
        if moment.moving and moment.line and began_s is not None and self._motion.now_s >= began_s:
            self.line = max(self.line, moment.line)  # others that come between count from 1
        queued = self._queued
        self._find_place(queued.progress, began_s is not None and self._motion.now_s >= began_s)
        if queued.done:
            self._ended(queued, now_s)
        elif self.phase is JobPhase.PAUSING and self._motion.paused:
            self.phase = JobPhase.PAUSED

    def _find_place(self, read: Progress, begun: bool) -> None:
        """Find where the line begins that is carried out."""
        self._places.read(read.line, read.done_bytes)
        # At standstill the reader itself waits, behind the line that it waits for.
        waits = begun and self._motion.standing
        place = self._places.begin_before(read.done_bytes) if waits else self._places.begin_of(self.line)
        self._done_bytes = max(self._done_bytes, place or 0)
        self._places.forget_before(self._done_bytes)

    def _follow_programs(self) -> None:
        """Follow what a program requested: pause, resume, cancel."""
        if self._queued.cancelled:
            self.phase = JobPhase.CANCELLING
        elif self._feeder.paused and self.phase is JobPhase.PRINTING:
            self.phase = JobPhase.PAUSING
        elif not self._feeder.paused and self.phase in (JobPhase.PAUSING, JobPhase.PAUSED):
            self.phase = JobPhase.PRINTING

    def _ended(self, queued: QueuedWork, now_s: float) -> None:
        self._feeder.resume()  # a pause that came too late must not hold what comes next
        if queued.error is not None:
            self._end(JobPhase.FAILED, str(queued.error), now_s)
        elif queued.cancelled:
            self._end(JobPhase.CANCELLED, "", now_s)
        else:
            self.size_bytes = self.size_bytes or queued.progress.done_bytes
            self.line = queued.progress.line
            self._end(JobPhase.DONE, "", now_s)

    def _end(self, phase: JobPhase, message: str, now_s: float) -> None:
        self.phase, self.message, self.ended_s = phase, message, now_s

    @property
    def _feeder(self) -> Feeder:
        return self._motion.feeder

"""Jobs without a file: their lines come piece by piece from a client, for as long as it likes.

The client opens the job with one request that lasts as long as the job, and feeds it with others: each is
answered when there is room for the next, so that the sender waits for the machine, and memory does not
grow. A client that leaves ends the job, since its open request ends: all lines that came are carried out, to
a standstill, and the job says why there were no more.

Two threads meet in a ``FedSource``: the control loop puts, the motion worker reads.
"""

import asyncio
from collections import deque
from typing import Final

from coordinator.gcode.program import Program
from coordinator.ipc.protocol.methods import ApiError, shown
from coordinator.service.core.interface import ServiceInterface
from coordinator.service.core.work import FileWork
from coordinator.service.jobs.jobs import JobPhase, JobRun
from nodes.support.errors import CanductorError

LINES_AHEAD_MAX: Final = 256
"""Lines that wait for the machine, without those of the piece that arrives when there is room."""
PIECE_BYTES_MAX: Final = 32_768
PIECE_LINES_MAX: Final = 1024
NAME_MAX: Final = 128
FAILURE_MAX: Final = 500


class FedEnd(CanductorError):  # noqa: N818 (the end of what is fed, before its time)
    """No more lines come though the program has not ended."""


class FedSource:
    """Text that comes when it comes; a ``ByteSource``."""

    def __init__(self) -> None:
        self.lines_put = 0
        self._pieces: deque[tuple[int, bytes]] = deque()
        self._lines_read = 0
        self._ended = False
        self._cause: str | None = None
        self.closed = False
        """Whether the job has let it go."""

    @property
    def lines_ahead(self) -> int:
        """Lines that are not read yet."""
        return self.lines_put - self._lines_read

    def put(self, lines: list[str]) -> None:
        """Add LINES, without their ends."""
        if lines:
            text = "".join(line + "\n" for line in lines)
            self.lines_put += len(lines)
            self._pieces.append((len(lines), text.encode(errors="replace")))

    def end(self, cause: str | None = None) -> None:
        """Let no more lines come: for CAUSE, or since this was all."""
        if not self._ended:
            self._cause = cause
            self._ended = True

    @property
    def ended(self) -> bool:
        """Whether no more lines come."""
        return self._ended

    def read(self, _size: int, /) -> bytes | None:
        """Return the oldest piece, None while there is none; raises FedEnd."""
        ended = self._ended  # before the look: what is put comes before the end
        try:
            count, data = self._pieces.popleft()
        except IndexError:
            if ended and self._cause is not None:
                raise FedEnd(self._cause) from None
            return b"" if ended else None
        self._lines_read += count
        return data

    def close(self) -> None:
        """Forget what was not read."""
        self.closed = True
        self._pieces.clear()


class FedJobs:
    """The job of SERVICE that is fed, one at a time; on the control loop."""

    def __init__(self, service: ServiceInterface) -> None:
        self._service = service
        self._source: FedSource | None = None
        self._job: JobRun | None = None
        self._changed = asyncio.Event()
        self._feeding = False

    def begin(self, name: str) -> JobRun:
        """Begin the job NAME; raises ApiError as the start of any job."""
        source = FedSource()
        job = self._service.start_job(FileWork(Program(source, name)), fed=True)
        self._source, self._job = source, job
        return job

    async def until_over(self, job: JobRun, who: str) -> None:
        """Wait until JOB is over; cancelled, let no more lines come, since WHO left."""
        source = self._source
        assert source is not None
        try:
            while job.active:
                await self._change()
        except asyncio.CancelledError:
            if job.active:
                self._break_off(job, source, f"the client {shown(who)} left")
            raise
        finally:
            if self._job is job:
                self._source = self._job = None
                self._changed.set()

    async def feed(
        self, name: str, first_line: int, lines: list[str], *, end: bool, failure: str | None
    ) -> int:
        """Add LINES to the job NAME, and return how many came so far, once there is room; raises ApiError."""
        job, source = self._job, self._source
        if job is None or source is None or job.file != name or not _takes_lines(job):
            raise ApiError("no_job", _why_none(name, self._service.job))
        final = end or failure is not None  # it waits for no room, so that an end is known at once
        if source.ended or (self._feeding and not final):
            raise ApiError("busy", f"{name} takes no lines now; wait for the answer to those before")
        if first_line != source.lines_put + 1:
            raise ApiError(
                "bad_params",
                f"{name} has {source.lines_put} lines so far, line {first_line} cannot come next",
            )
        source.put(lines)
        job.lines_fed = source.lines_put
        if failure is not None:
            self._break_off(job, source, failure)
        elif end:
            source.end()
        if final:
            self._changed.set()
            return source.lines_put
        self._feeding = True
        try:
            while _takes_lines(job) and not source.ended and source.lines_ahead >= LINES_AHEAD_MAX:
                await self._change()
        finally:
            self._feeding = False
        if not _takes_lines(job) and not source.ended:
            raise ApiError("no_job", _why_none(name, job))
        return source.lines_put

    def look(self) -> None:
        """Wake who waits; called every cycle of motion."""
        if self._job is not None:
            self._changed.set()

    async def _change(self) -> None:
        self._changed.clear()
        await self._changed.wait()

    def _break_off(self, job: JobRun, source: FedSource, cause: str) -> None:
        if source.ended:
            return
        count = source.lines_put
        came = "no line came" if count == 0 else f"all that came, to line {count}, is carried out"
        sentence = f"{job.file}: {cause}; {came}"
        source.end(sentence)
        self._service.log.add("job", f"{sentence} before the job ends" if count else sentence)


def _takes_lines(job: JobRun) -> bool:
    return job.active and job.phase is not JobPhase.CANCELLING


def _why_none(name: str, job: JobRun | None) -> str:
    """Return why the job NAME takes no more lines."""
    if job is None or job.file != name or _takes_lines(job):
        return f"there is no job {name} that is fed; job.stream begins one"
    reasons = {
        JobPhase.DONE: f"{name} has ended",
        JobPhase.FAILED: job.message,
        JobPhase.STOPPED: f"{name}: the machine stopped: {job.message}",
    }
    return reasons.get(job.phase, f"{name} was cancelled at the machine")

"""What programs and modules want of a service: lines run by themselves, files printed, the job's figures."""

import asyncio
import contextlib
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from typing import Any, Final

from coordinator.gcode.commands import Recovering
from coordinator.gcode.reply_kinds import ReplyKind
from coordinator.ipc.protocol.methods import ApiError
from coordinator.modules.programs.gcode_macro import words_in
from coordinator.modules.programs.pause_resume import PauseResume
from coordinator.modules.programs.virtual_sdcard import VirtualSdcard
from coordinator.modules.status.print_stats import PrintStats
from coordinator.runtime.machine import Machine
from coordinator.service.core.feeder import FeederFull
from coordinator.service.core.interface import ServiceInterface
from coordinator.service.core.motion import MotionOver
from coordinator.service.core.work import FileWork, LinesWork, Rest
from coordinator.service.jobs.jobs import JobPhase, JobRun
from coordinator.service.jobs.recovery import Recovery
from coordinator.support.values import Value
from nodes.support.errors import CanductorError

_STATES: Final[Mapping[JobPhase, str]] = {
    JobPhase.NONE: "standby",
    JobPhase.PRINTING: "printing",
    JobPhase.PAUSING: "paused",
    JobPhase.PAUSED: "paused",
    JobPhase.CANCELLING: "printing",
    JobPhase.DONE: "complete",
    JobPhase.CANCELLED: "cancelled",
    JobPhase.FAILED: "error",
    JobPhase.STOPPED: "error",
}


def _nothing() -> None:
    pass


class Programs:
    """Serves the modules of SERVICE's machine (coordinator/runtime/module_runner.py); on the control loop."""

    def __init__(self, service: ServiceInterface, recovery: Recovery) -> None:
        self._service = service
        self._recovery = recovery
        self._tasks: set[asyncio.Task[None]] = set()
        self._stats: PrintStats | None = None
        self._card: VirtualSdcard | None = None
        self._pauses: PauseResume | None = None
        self._told: tuple[JobRun, JobPhase] | None = None
        self.remote_methods: frozenset[str] = frozenset()
        """Names of what clients have registered; replaced, never changed."""
        self.on_remote: Callable[[str, Mapping[str, object]], None] | None = None
        """Calls one of these at those clients."""

    def live_motion(self) -> tuple[Sequence[float], float, float] | None:
        """Return where the head is now (X Y Z E, mm), and the speeds of head and filament, mm/s."""
        motion = self._service.motion
        if motion is None:
            return None
        moment = motion.moment()
        return moment.position, moment.velocity_mm_s, moment.extruder_mm_s

    def begin(self, machine: "Machine") -> None:
        """Serve MACHINE, which has just been made ready."""
        machine.runner = self
        self._stats = next(machine.modules.of(PrintStats), None)
        self._card = next(machine.modules.of(VirtualSdcard), None)
        self._pauses = next(machine.modules.of(PauseResume), None)
        # A job of an earlier machine is over and no longer reported.
        last = self._service.job
        self._told = None if last is None or last.active else (last, last.phase)
        if self._card is None:
            return
        folder = self._service.job_folder(self._card.path)
        self._card.files = lambda: [(job.name, job.size_bytes) for job in folder.files()]
        self._card.check = lambda name: folder.open(name).close()

    # ------------------------------------------------------------------------------------ for modules

    @property
    def busy(self) -> bool:
        """Whether there is a job that is not paused, or anything moves, dwells or waits."""
        motion, job = self._service.motion, self._service.active_job
        return (job is not None and not job.gives_way) or (motion is not None and motion.in_use)

    @property
    def moved(self) -> int:
        """How many works have moved anything so far."""
        return 0 if self._service.motion is None else self._service.motion.moved

    @property
    def paused(self) -> bool:
        """Whether there is a job that is paused."""
        job = self._service.active_job
        return job is not None and job.gives_way

    def run_lines(
        self, name: str, lines: Sequence[str], text: str = "", *, on_end: Callable[[], None] = _nothing
    ) -> None:
        """Have g-code LINES done as those of a client."""
        motion = self._service.motion
        if motion is not None and words_in(text) & motion.feeder.vocabulary.interrupting:
            self._start(self._run_paused(LinesWork(lines, name=name), stay=False, on_end=on_end))
        else:
            self._start(self._run(LinesWork(lines, name=name, rest=Rest.OPEN), on_end))

    def call_remote(self, name: str, values: Mapping[str, object]) -> None:
        """Have every client that registered the method NAME called with VALUES."""
        if self.on_remote is not None:
            self.on_remote(name, values)

    def run_paused(self, name: str, lines: Sequence[str], *, stay: bool) -> None:
        """Have LINES done with the job paused."""
        self._start(self._run_paused(LinesWork(lines, name=name), stay=stay))

    async def _run_paused(
        self, work: LinesWork, *, stay: bool, on_end: Callable[[], None] = _nothing
    ) -> None:
        with self.interrupted(stay=stay):
            await self._run(work, on_end)

    @contextlib.contextmanager
    def interrupted(self, *, stay: bool) -> Iterator[None]:
        """Pause a job that prints; it goes on unless something in between paused it, or with STAY."""
        job = self._service.active_job
        if job is None or job.gives_way or job.phase is JobPhase.CANCELLING:
            yield
            return
        job.pause()
        try:
            yield
        finally:
            paused = self._pauses is not None and self._pauses.status()["is_paused"]
            if not (stay or paused) and job.phase in (JobPhase.PAUSING, JobPhase.PAUSED):
                job.resume()

    async def _run(self, work: LinesWork, on_end: Callable[[], None] = _nothing) -> None:
        motion, job = self._service.motion, self._service.active_job
        if motion is None:
            return
        log = self._service.log
        try:
            if job is not None and not job.gives_way:
                work.while_printing = True
                queued = await motion.do_interjection(work)
                for output in queued.output:
                    self._service.report(output)
                    await asyncio.sleep(0)  # there may be a thousand
            else:
                queued = await motion.do(work)
        except FeederFull as error:
            log.add("notice", f"{work.name} was left out: {error}", ReplyKind.ERROR)
        except MotionOver:
            return
        else:
            if queued.error is not None:
                log.add("notice", str(queued.error), ReplyKind.ERROR)
        on_end()

    # ------------------------------------------------------------------------------------ for the job

    def look(self) -> None:
        """Report the job to modules, and start the files that programs want printed."""
        motion, job = self._service.motion, self._service.job
        if motion is not None and motion.feeder.to_print:
            self._start(self._print(motion.feeder.to_print.popleft()))
        if motion is not None and motion.feeder.to_recover:
            self._start(self._recover(motion.feeder.to_recover.popleft()))
        if job is None or not (job.active or (job, job.phase) != self._told):
            return
        if (
            self._pauses is not None
            and job.phase is JobPhase.PRINTING
            and self._told == (job, JobPhase.PAUSED)
        ):
            self._pauses.resumed()
        if self._stats is not None:
            self._stats.job = self._figures(job)
        if self._card is not None:
            self._card.place = {
                "file_position": job.done_bytes,
                "file_size": job.size_bytes,
                "progress": job.progress,
            }
            if job.phase is JobPhase.FAILED and (job, job.phase) != self._told and self._card.acts_on_error:
                self.run_lines("on_error_gcode", ["_ON_ERROR_GCODE"])
        self._told = (job, job.phase)

    def _state(self, job: JobRun) -> str:
        """Return how JOB is; while it is being cancelled what it was before: it does not go on."""
        output = "" if self._stats is None else self._stats.state
        if job.phase is JobPhase.CANCELLING and output in ("printing", "paused"):
            return output
        return _STATES[job.phase]

    def _figures(self, job: JobRun) -> Mapping[str, Value]:
        return {
            "state": self._state(job),
            "filename": job.file,
            "total_duration": round((job.ended_s or self._service.now_s) - job.began_s, 3),
            "print_duration": round(job.print_duration_s, 3),
            "filament_used": round(job.filament_mm, 5),
            "message": job.message,
        }

    async def _print(self, name: str) -> None:
        service = self._service
        if service.folder is None:
            service.log.add(
                "notice",
                f"{name} is not printed: there is no job folder; start with --jobs FOLDER",
                ReplyKind.ERROR,
            )
            return
        try:
            program = await asyncio.to_thread(service.folder.open, name)
            try:
                service.start_job(FileWork(program), behind_others=True)
            except BaseException:
                program.close()
                raise
        except (CanductorError, ApiError) as error:
            service.log.add("notice", f"{name} is not printed: {error}", ReplyKind.ERROR)

    async def _recover(self, how: Recovering) -> None:
        try:
            await self._recovery.recover(how)
        except (CanductorError, MotionOver) as error:
            self._service.log.add("notice", f"RESUME_INTERRUPTED: {error}", ReplyKind.ERROR)

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

"""The machine as a service: it starts, is ready, prints, stops and restarts, for clients or for one job.

One object owns it. All of it runs on the control loop; clients' methods only change attributes or wait.
"""

import asyncio
import contextlib
import secrets
import time
import traceback
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Final

from coordinator.config.model import MachineDescription
from coordinator.gcode.events import Notice
from coordinator.gcode.program import Program
from coordinator.gcode.reply_kinds import ReplyKind
from coordinator.ipc.protocol.methods import ApiError
from coordinator.ipc.protocol.overtaken import is_overtaken
from coordinator.ipc.server.state import StateTree
from coordinator.modules.module_set import build_modules
from coordinator.runtime.host import Host
from coordinator.runtime.machine import Machine, MachineStopped
from coordinator.service.core.memory import collect_garbage, give_back, keep_small, pass_by_what_stays
from coordinator.service.core.motion import Motion
from coordinator.service.core.programs import Programs
from coordinator.service.core.tables import TableService
from coordinator.service.core.turns import Turns
from coordinator.service.core.work import FileWork
from coordinator.service.jobs.fed import FedJobs
from coordinator.service.jobs.history import EndedJob, JobHistory
from coordinator.service.jobs.job_folder import JobFolder, JobFolderClaim
from coordinator.service.jobs.jobs import JobPhase, JobRun
from coordinator.service.jobs.journal import journal_path
from coordinator.service.jobs.outcome import Outcome, job_progress, outcome_of
from coordinator.service.jobs.recovery import Recovery
from coordinator.service.state.figures import Figures
from coordinator.service.state.log_ring import Entry, LogRing
from coordinator.streaming.move_source import ProgramOutput
from coordinator.streaming.pipeline import PlanRecord
from coordinator.support.bug_log import log_bug
from coordinator.support.file_writer import FileWriter
from coordinator.support.progress import Progress
from coordinator.tables.store import TableStore
from nodes.dictionary.cache import DictionaryCache
from nodes.node.errors import NodeShutdown
from nodes.support.errors import CanductorError

REFRESH_S: Final = 0.1
"""How often the state tree is brought up to date while somebody reads it; else the next look fills it."""
READ_S: Final = 1.5
"""So long after somebody has read it, it counts as being read."""
WRITE_S: Final = 10.0
"""A disk that does not answer must not keep the service from ending; one that is slow gets what was saved."""
BY_USER: Final = "emergency stop by"
BY_INTERRUPT: Final = "stopped by the user"


class ServiceState(StrEnum):
    """What the machine is doing."""

    STARTUP = "startup"
    READY = "ready"
    PRINTING = "printing"
    PAUSED = "paused"
    SHUTDOWN = "shutdown"
    """Stopped for safety; ``machine.restart`` starts it again."""
    ERROR = "error"
    """The start failed; remove the cause, then call ``machine.restart``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceSettings:
    """What the service may do for its clients."""

    name: str
    jobs: Path | None = None
    """The folder of files that may be printed; None: there are no jobs."""
    node_commands: bool = False
    """Whether ``node.command`` may send raw commands."""
    id: str = field(default_factory=lambda: secrets.token_hex(8))
    """Of this run of the service: shows whether two addresses lead to the same one."""
    tables: Path | None = None
    """Where accepted axis tables are kept; None: only as long as the service lives."""
    state: Path | None = None
    """Folder of what outlives the service: the journal of jobs; None: no journal is kept."""
    own_process: bool = False
    """Whether the process runs nothing else: the service controls its garbage collector and allocator."""


class MachineService:
    """Runs the machine that LOAD describes (called again at every restart; CanductorError).

    ``run`` serves clients until it is cancelled, ``run_job`` prints one program. ON_LINE gets every line of
    the log, ON_OUTPUT every reply and notice in full. RECORD keeps all that is planned, for a proof; memory
    grows with it.
    """

    def __init__(
        self,
        load: Callable[[], MachineDescription],
        host: Host,
        state: StateTree,
        settings: ServiceSettings,
        *,
        cache: DictionaryCache | None = None,
        record: PlanRecord | None = None,
        on_line: Callable[[Entry], None],
        on_output: Callable[[ProgramOutput], None] = lambda _: None,
    ) -> None:
        self.settings = settings
        self.state = ServiceState.STARTUP
        self.cause = ""
        """Why it is in shutdown or error: a sentence."""
        self.log = LogRing(on_line)
        self._on_output = on_output
        self.folder = None if settings.jobs is None else JobFolder(settings.jobs)
        self._claimed: JobFolderClaim | None = None
        self.machine: Machine | None = None
        self.motion: Motion | None = None
        self.job: JobRun | None = None
        """The last one, also when it has ended."""
        self.confirmed_s: dict[str, float] = {}
        """By node: how long after the stop it confirmed it."""
        self.tables = TableService(
            None if settings.tables is None else TableStore(settings.tables),
            state,
            self._notice,
        )
        self.starts = 0
        self.cut_off = False
        """Whether ``run`` was ended while something moved."""
        self.host = host
        self._load = load
        self.tree = state
        self._cache = cache
        self._record = record
        self._figures = Figures(state)
        self._shown_s = self._read_s = float("-inf")
        """When the tree was brought up to date, and when somebody wanted it to be."""
        self._reading = asyncio.Event()
        """Set when ``_refresh`` has to go on: somebody reads the tree."""
        self._reported = ""
        """Where the last bug was that kept the tree from being filled."""
        state.bring_up_to_date = self._bring_up_to_date
        self.recovery = Recovery(self, settings.state)
        self.programs = Programs(self, self.recovery)
        self.turns = Turns()
        """For scripts of clients."""
        self.fed = FedJobs(self)
        self._files = FileWriter()
        """Of all machines, one after the other: what one of them keeps is what the next one finds."""
        self.history = JobHistory(self._notice, self._files)
        self._restart = asyncio.Event()
        self._reset_nodes = False
        """At the next start, whatever their configuration."""
        self._asked_to_stop: str | None = None
        """By somebody, while it starts, or is about to start again."""
        self._closing: Machine | None = None
        """The one before, while it is closed."""
        self.find_unread_stop: Callable[[], str | None] = _nobody
        """Returns who stops the machine with what has come and was not read; None: nobody does."""

    # ------------------------------------------------------------------------------------------- life

    async def run(self) -> None:
        """Serve clients until cancelled; when that happens during motion, stop all nodes, as Ctrl-C does.

        Raises JobFolderInUse, before anything is done, when another service has the job folder.
        """
        self.claim_folder()
        self.tables.read()
        if self.settings.own_process:
            keep_small()
        refresh = asyncio.ensure_future(self._refresh())
        try:
            while True:
                if self.settings.own_process:
                    collect_garbage()  # while there is nothing to be stopped
                try:
                    await self._live_once()
                except Exception as bug:
                    if self.state is not ServiceState.STARTUP:
                        raise
                    self._enter(ServiceState.ERROR, await asyncio.to_thread(log_bug, bug))
                await self._restart.wait()
                await self._let_go()
        except asyncio.CancelledError:
            await self._stop_if_moving()
            raise
        finally:
            refresh.cancel()
            await asyncio.gather(refresh, return_exceptions=True)
            await self._let_go()
            await asyncio.to_thread(self.recovery.close)
            await self._finish_writing()
            self._unclaim()

    async def run_job(
        self,
        program: Program,
        *,
        on_ready: Callable[[Machine], None],
        on_progress: Callable[[Progress], None] | None,
    ) -> Outcome:
        """Start the machine, print PROGRAM and return the result; ON_READY gets the machine before that.

        Programs have no job control then: nobody could resume. Raises CanductorError; cancelled, or when the
        machine cannot go on, all nodes are stopped.
        """
        self.tables.read()
        try:
            machine = await self._start(self._load())
            on_ready(machine)
            try:
                return await self._print(machine, program, on_progress)
            except asyncio.CancelledError:
                machine.stop(BY_INTERRUPT)
                await machine.confirm_stop()
                raise
        finally:
            await self._let_go()
            await self._finish_writing()

    async def _print(
        self, machine: Machine, program: Program, on_progress: Callable[[Progress], None] | None
    ) -> Outcome:
        def look() -> None:
            self.look()
            if on_progress is not None:
                on_progress(job_progress(machine, motion, job, self.now_s))

        async with self._stop_on_failure(machine):
            motion = self._begin_motion(machine, look, has_jobs=False)
            job = self.start_job(FileWork(program))
            motion.finish()
            await motion.run()
            if job.error is None:
                return await outcome_of(machine, motion.streamer)
        if machine.stopped is not None:
            raise MachineStopped(f"{machine.stopped}{_confirmations(self.confirmed_s)}")
        assert job.error is not None
        raise job.error

    async def _live_once(self) -> None:
        """Start, move, and return when that is over; ``state`` has the reason."""
        self._restart.clear()  # without an await up to STARTUP: a stop is not missed
        self.confirmed_s = {}
        self.starts += 1
        self._enter(ServiceState.STARTUP)
        self.machine = None
        try:
            description = await asyncio.to_thread(self._load)
            try:
                machine = await self._start(description)
            except NodeShutdown as error:
                if self._asked_to_stop is not None:
                    raise
                # The service before this one was killed a moment ago, and the node lost its host.
                self._notice(f"{error}; all nodes are reset and started again")
                self._reset_nodes = True
                machine = await self._start(description)
        except CanductorError as error:
            stopped = None if self.machine is None else self.machine.stopped
            self._enter(ServiceState.SHUTDOWN if stopped else ServiceState.ERROR, str(stopped or error))
            return
        await self._serve_clients(machine)

    async def _start(self, description: MachineDescription) -> Machine:
        """Return the machine, ready; raises CanductorError."""
        machine = self.machine = Machine(
            description,
            self.host,
            build_modules(description, self._files),
            on_notice=self._notice,
            cache=self._cache,
            reset_nodes=self._reset_nodes,
            prepare_restart=self._prepare_restart,
        )
        self._reset_nodes = False
        if self._asked_to_stop is not None:
            machine.stop(self._asked_to_stop)
        await machine.start()
        return machine

    async def _serve_clients(self, machine: Machine) -> None:
        care = asyncio.ensure_future(self.tables.care(machine, self.stands))
        try:
            async with self._stop_on_failure(machine):
                self.programs.begin(machine)
                self.recovery.open()
                if self.folder is not None and self.settings.state is not None:
                    self.history.open(journal_path(self.settings.state, self.folder.path, "history"))
                await self._begin_motion(machine, self.look).run()
        finally:
            care.cancel()
            (ended,) = await asyncio.gather(care, return_exceptions=True)
            if isinstance(ended, Exception):
                raise ended  # a bug: it handles all failures that are to be expected

    def _begin_motion(
        self, machine: Machine, on_cycle: Callable[[], None], *, has_jobs: bool = True
    ) -> Motion:
        motion = self.motion = Motion(
            machine,
            on_output=self.report,
            on_cycle=on_cycle,
            on_planned=self._note_new_heights,
            record=self._record,
            compensation=self.tables.compensation_of(machine),
            has_jobs=has_jobs,
        )
        if self.settings.own_process:
            pass_by_what_stays()
        self._enter(ServiceState.READY)
        return motion

    def _note_new_heights(self) -> None:
        """Write down new heights before the commands that lead to them are handed over."""
        if self.recovery.has_new_heights():
            self.look()

    @contextlib.asynccontextmanager
    async def _stop_on_failure(self, machine: Machine) -> AsyncIterator[None]:
        """Stop MACHINE when the block raises; a CanductorError ends here, with the state SHUTDOWN."""
        try:
            yield
        except CanductorError as error:
            machine.stop(str(error))
            self._stopped(machine)
            self.confirmed_s = await machine.confirm_stop()
        except Exception as bug:
            machine.stop(f"internal error: {type(bug).__name__}: {bug}; all nodes were stopped")
            raise

    def _stopped(self, machine: Machine) -> None:
        """Enter SHUTDOWN; without effect when that was done."""
        if self.state is ServiceState.SHUTDOWN:
            return
        cause = str(machine.stopped)
        if self.job is not None:
            was_active = self.job.active
            self.job.stop(cause, self.now_s)
            if was_active:
                self._job_ended(self.job)
            self.fed.look()
        self._enter(ServiceState.SHUTDOWN, cause)

    async def _stop_if_moving(self) -> None:
        machine = self.machine
        self.cut_off_motion()
        if self.cut_off and machine is not None:
            await machine.confirm_stop()

    async def _let_go(self) -> None:
        self._closing = self.machine or self._closing  # also one whose close was cancelled
        self.machine = self.motion = None
        if self._closing is not None:
            await self._closing.close()
            self._closing = None

    async def _finish_writing(self) -> None:
        """Wait for the disk, as far as it answers."""
        if not await asyncio.to_thread(self._files.wait, WRITE_S):
            self._notice(f"the disk has not answered for {WRITE_S:.0f} s; what was saved last may be lost")

    # ------------------------------------------------------------------------------------------- doing

    def emergency_stop(self, who: str) -> None:
        """Stop all nodes, ahead of everything queued; takes effect before this returns."""
        cause = f"{BY_USER} {who}"
        if self.state is ServiceState.STARTUP or self._restart.is_set():
            self._asked_to_stop = cause  # whatever machine is there by then
        if self.machine is None:
            return
        self.machine.stop(cause)
        if self.motion is not None:
            self._stopped(self.machine)

    @property
    def moves(self) -> bool:
        """Whether anything moves, on a machine that was not stopped; from any thread."""
        machine, motion = self.machine, self.motion
        return machine is not None and machine.stopped is None and motion is not None and not motion.standing

    def cut_off_motion(self) -> None:
        """Stop all nodes for Ctrl-C or SIGTERM, if anything moves."""
        if self.moves:
            assert self.machine is not None
            self.cut_off = True
            self.machine.stop(BY_INTERRUPT)

    def restart(self, *, firmware: bool = False) -> None:
        """Restart with the configuration read again; raises ApiError while the machine starts or works.

        Nodes are configured again where that is needed; with FIRMWARE all are reset. While a stop is unread
        it raises ApiError, too: the stop lane may have carried it out, and read later it would stop the
        machine that this makes. So it does for a request behind which the same client has sent a stop.
        """
        if is_overtaken():
            raise ApiError(
                "busy", "an emergency stop that was sent behind it came first; ask again for a restart"
            )
        if self.state is ServiceState.STARTUP:
            raise ApiError("busy", "the machine is starting already")
        if self._restart.is_set():
            firmware |= self._reset_nodes
        elif self.state not in (ServiceState.SHUTDOWN, ServiceState.ERROR):
            motion = self.ready_motion()
            if motion.feeder.busy or not motion.standing:
                raise ApiError("busy", self._why_busy(motion))
        if (who := self.find_unread_stop()) is not None:  # it takes time where clients have sent much
            raise ApiError("busy", f"an emergency stop by {who} has just come; ask again when it is done")
        self._restart_now(firmware)

    def _why_busy(self, motion: Motion) -> str:
        """Return why the machine cannot restart while it works, and what to do."""
        if self.active_job is not None:
            return "a job prints or is paused; wait for its end, or cancel it with job.cancel"
        stop = "or stop the machine first with machine.emergency_stop"
        if motion.feeder.busy and motion.standing:
            return (
                "g-code of a client is not done: it homes, probes or waits, such as M109 for a heater; wait"
                f" for its end, cancel that call, {stop}"
            )
        return f"the machine moves; wait until it stands, {stop}"

    def restart_in_job(self, *, firmware: bool) -> None:
        """Cancel the job, which ends before its next line, and restart when its moves are done."""
        assert self.active_job is not None
        self.active_job.cancel()
        self._restart_now(firmware)

    def _restart_now(self, firmware: bool) -> None:
        self._asked_to_stop = None
        self._reset_nodes = firmware
        self._restart.set()
        if self.motion is not None:
            self.motion.finish_early()

    def _prepare_restart(self) -> Callable[[bool], None]:
        """Return the function by which a program restarts the machine; raises ApiError in a job."""
        if self.active_job is not None:
            raise ApiError("busy", "a job prints; wait for its end, or cancel it with job.cancel")
        return self._restart_now

    def start_job(self, work: FileWork, *, behind_others: bool = False, fed: bool = False) -> JobRun:
        """Print; raises ApiError unless the machine is ready and idle, or BEHIND_OTHERS without a job.

        FED: its lines come from a client.
        """
        motion = self.ready_motion()
        if motion.feeder.busy and (not behind_others or self.active_job is not None):
            raise ApiError(
                "busy", "the machine is busy; wait for its moves, or cancel them, then start the job"
            )
        self.up_machine().modules.job_begins()
        motion.toolpath.clear()
        self.job = JobRun(motion, work, self.now_s)
        self.job.lines_fed = 0 if fed else None
        self.recovery.begin(self.job, work)
        self.log.add("job", f"{self.job.file}: started")
        self.look()
        return self.job

    def job_folder(self, otherwise: Path) -> JobFolder:
        """Return the folder of jobs; the one at OTHERWISE unless the settings name one."""
        if self.folder is None or self.settings.jobs is None:
            self._unclaim()
            self.folder = JobFolder(otherwise)
            self.claim_folder()
        return self.folder

    def claim_folder(self) -> None:
        """Keep other services out of the job folder; raises JobFolderInUse. ``run`` does so, too."""
        if self.folder is not None and self._claimed is None:
            self._claimed = JobFolderClaim(self.folder.path)

    def _unclaim(self) -> None:
        claimed, self._claimed = self._claimed, None
        if claimed is not None:
            claimed.close()

    # ------------------------------------------------------------------------------------------- state

    @property
    def now_s(self) -> float:
        """Host time in s."""
        return self.host.now() * 1e-9

    @property
    def active_job(self) -> JobRun | None:
        """The job that is on its way."""
        return self.job if self.job is not None and self.job.active else None

    def stands(self) -> bool:
        """Return whether nothing moves, and nothing is about to."""
        motion = self.motion
        return motion is not None and motion.standing and not motion.feeder.busy and self.active_job is None

    def ready_motion(self) -> Motion:
        """Return what moves the machine; raises ApiError when that is not possible now."""
        motion = self.motion
        if self._restart.is_set():  # what is begun now would never be done
            raise ApiError("not_ready", "the machine is about to restart; wait until it is ready")
        if self.state is ServiceState.SHUTDOWN:
            raise ApiError("stopped", f"the machine stopped: {self.cause}; machine.restart starts it again")
        if motion is None or self.state in (ServiceState.STARTUP, ServiceState.ERROR):
            cause = f": {self.cause}" if self.cause else ""
            raise ApiError("not_ready", f"the machine is in {self.state}{cause}")
        return motion

    def up_machine(self) -> Machine:
        """Return the machine, in whatever state; raises ApiError where there is none."""
        if self.machine is None:
            raise ApiError(
                "not_ready", f"the machine is in {self.state}: {self.cause or 'no node is connected'}"
            )
        return self.machine

    # ------------------------------------------------------------------------------------------- inside

    def look(self) -> None:
        """Bring job and state up to date; called every cycle of motion, and before somebody asks."""
        job = self.job
        if job is not None and job.active:
            before = job.phase
            job.look(self.now_s)
            if job.phase is not before:
                self.log.add("job", f"{job.file}: {job.phase}" + (f": {job.message}" if job.message else ""))
                if not job.active:
                    self._job_ended(job)
        self.fed.look()
        self.programs.look()
        self.recovery.look()
        if self.motion is None or self.state in (ServiceState.SHUTDOWN, ServiceState.ERROR):
            return
        held = self.motion.streamer.held
        wanted = ServiceState.READY
        if job is not None and job.active:
            waits = job.phase is JobPhase.PAUSED or (held is not None and self.motion.standing)
            wanted = ServiceState.PAUSED if waits else ServiceState.PRINTING
        if wanted is not self.state:
            self._enter(wanted, held or "")
        self.tables.show_corrections()

    def _job_ended(self, job: JobRun) -> None:
        assert job.ended_s is not None
        self.history.add(
            EndedJob(
                file=job.file,
                state=str(job.phase),
                message=job.message,
                ended_s=round(time.time(), 3),
                elapsed_s=round(job.ended_s - job.began_s, 1),
                print_time_s=round(job.print_time_s, 1),
                filament_mm=round(job.filament_mm, 1),
            )
        )
        if self.settings.own_process:
            give_back()

    def _enter(self, state: ServiceState, cause: str = "") -> None:
        self.state, self.cause = state, cause
        self.tree.update("machine", {"state": str(state), "cause": cause, "starts": self.starts})
        self.log.add("state", f"{state}: {cause}" if cause else str(state))
        self._figures.show(self)

    def report(self, output: ProgramOutput) -> None:
        """Log a reply or a notice of a line of g-code."""
        if isinstance(output, Notice):
            self.log.add("notice", output.text, ReplyKind.INFORMATION)
        else:
            self.log.add("reply", output.text, output.kind)
        self._on_output(output)

    def _notice(self, text: str) -> None:
        """Log a sentence of the machine."""
        self.log.add("notice", text)
        self._on_output(Notice(0, text))

    def _bring_up_to_date(self) -> None:
        """Fill the tree for somebody who reads, unless ``_refresh`` has done so."""
        self._read_s = self.now_s
        self._reading.set()
        if self._read_s - self._shown_s >= 2 * REFRESH_S:
            self._shown_s = self._read_s
            with self._showing():
                self._figures.show(self)

    async def _refresh(self) -> None:
        """Keep the tree up to date while it is read; a look at it should find it filled."""
        while True:
            with self._showing():
                for _ in self._figures.parts(self):
                    await asyncio.sleep(0)
            self._shown_s = self.now_s
            if self.now_s - self._read_s < READ_S:
                await asyncio.sleep(REFRESH_S)
                continue
            self._reading.clear()
            await self._reading.wait()

    @contextlib.contextmanager
    def _showing(self) -> Iterator[None]:
        """Let the block end where the machine stops, or something has a bug, which is reported once."""
        try:
            yield
        except MachineStopped:
            pass
        except Exception as bug:  # noqa: BLE001 (who looks at a machine must not be what ends its display)
            *_, (frame, line) = traceback.walk_tb(bug.__traceback__)
            if (place := f"{frame.f_code.co_filename}:{line}") != self._reported:
                self._reported = place
                asyncio.get_running_loop().call_exception_handler(
                    {"message": "canductor: the state could not be brought up to date", "exception": bug}
                )


def _nobody() -> None:
    pass


def _confirmations(confirmed_s: dict[str, float]) -> str:
    """Return the part of a sentence that states how fast the nodes confirmed the stop."""
    nodes = [f"{name} after {delay_s * 1e3:.0f} ms" for name, delay_s in confirmed_s.items()]
    return f" ({', '.join(nodes)})" if nodes else ""

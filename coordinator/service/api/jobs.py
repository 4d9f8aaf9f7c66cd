"""Methods about jobs: files of the job folder, one at a time."""

import asyncio
from base64 import b64encode
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any, Final

from coordinator.gcode.commands import Recovering
from coordinator.gcode.thumbnail import HEAD_BYTES, Thumbnail, thumbnails
from coordinator.ipc.protocol.methods import ApiError, Caller, Kind, Method, Param, Scope, shown
from coordinator.service.core.machine_service import MachineService
from coordinator.service.core.motion import MotionOver
from coordinator.service.core.work import FileWork
from coordinator.service.jobs.fed import FAILURE_MAX, NAME_MAX, PIECE_BYTES_MAX, PIECE_LINES_MAX
from coordinator.service.jobs.history import HISTORY_MAX
from coordinator.service.jobs.job_folder import FILES_MAX, JobFolder, NoSuchJob
from coordinator.service.jobs.jobs import JobPhase, JobRun
from coordinator.service.state.figures import job_figures
from coordinator.support.job_names import PATH_BYTES_MAX
from coordinator.support.values import Value

_LISTED_MAX: Final = 1000
_JOB: Final = (
    Param("state", Kind.STR, ", ".join(JobPhase)),
    Param("file", Kind.STR, "null before the first job"),
    Param("progress", Kind.FLOAT, "the part that is carried out, 0 to 1"),
    Param("line", Kind.INT, "being carried out"),
    Param("lines_fed", Kind.INT, "that came so far, of a job that is fed; null: it is a file"),
    Param("print_time_s", Kind.FLOAT, "pauses left out", "s"),
    Param("elapsed_s", Kind.FLOAT, "with pauses", "s"),
    Param("message", Kind.STR, "why it failed or stopped"),
)


class _Jobs:
    """What the methods do."""

    def __init__(self, service: MachineService) -> None:
        self._service = service
        self._one_picture = asyncio.Lock()
        """Held while a thread searches a file for pictures: it shares Python with the control loop."""

    async def list(self, _caller: Caller, params: dict[str, Any]) -> Value:
        folder, first = self._folder(), params["first"]
        try:
            files = await asyncio.to_thread(folder.files)
        except NoSuchJob as error:
            raise ApiError("no_such_file", str(error)) from None
        page = files[first : first + _LISTED_MAX]
        return {
            "files": [
                {"name": job.name, "size_bytes": job.size_bytes, "modified_s": round(job.modified_s, 3)}
                for job in page
            ],
            "count": len(files),
        }

    async def start(self, _caller: Caller, params: dict[str, Any]) -> Value:
        self._service.ready_motion()  # says so before the disk is looked at
        folder = self._folder()
        try:
            program = await asyncio.to_thread(folder.open, params["file"])
        except NoSuchJob as error:
            raise ApiError("no_such_file", str(error)) from None
        try:
            self._service.start_job(FileWork(program))
        except BaseException:
            program.close()
            raise
        return self._status()

    def pause(self, _caller: Caller, _params: dict[str, Any]) -> Value:
        self._uncancelled().pause()
        return self._status()

    def resume(self, _caller: Caller, _params: dict[str, Any]) -> Value:
        self._uncancelled().resume()
        return self._status()

    def cancel(self, _caller: Caller, _params: dict[str, Any]) -> Value:
        self._active().cancel()
        return self._status()

    async def stream(self, caller: Caller, params: dict[str, Any]) -> Value:
        fed = self._service.fed
        job = fed.begin(_name(params["name"]))
        await fed.until_over(job, caller.name)
        return job_figures(job, self._service.now_s)

    async def feed(self, _caller: Caller, params: dict[str, Any]) -> Value:
        lines = params["text"].removesuffix("\n").split("\n") if params["text"] else []
        if len(lines) > PIECE_LINES_MAX:
            raise ApiError("bad_params", f"job.feed: {len(lines)} lines; at most {PIECE_LINES_MAX} at once")
        name, failure = params["name"], params["failure"]
        came = await self._service.fed.feed(
            name, params["first_line"], lines, end=params["end"], failure=failure
        )
        return {"lines": came}

    async def recover(self, _caller: Caller, params: dict[str, Any]) -> Value:
        try:
            await self._service.recovery.recover(Recovering(params["line"], params["home"], params["z"]))
        except MotionOver:
            raise ApiError("stopped", f"the machine stopped: {self._service.cause}") from None
        return self._status()

    def status(self, _caller: Caller, _params: dict[str, Any]) -> Value:
        return self._status()

    def history(self, _caller: Caller, _params: dict[str, Any]) -> Value:
        return {"jobs": [asdict(job) for job in self._service.history.jobs]}

    async def thumbnail(self, _caller: Caller, params: dict[str, Any]) -> Value:
        folder, most = self._folder(), params["pixels_max"]
        try:
            async with self._one_picture:
                pictures = await asyncio.to_thread(_pictures, folder, params["file"])
        except NoSuchJob as error:
            raise ApiError("no_such_file", str(error)) from None
        fitting = [picture for picture in pictures if max(picture.width, picture.height) <= most]
        if not fitting:
            return {"width": None, "height": None, "png": None}
        best = fitting[-1]
        return {"width": best.width, "height": best.height, "png": b64encode(best.png).decode()}

    def _folder(self) -> JobFolder:
        if self._service.folder is None:
            raise ApiError("no_such_file", "there is no job folder; start canductor with --jobs FOLDER")
        return self._service.folder

    def _active(self) -> JobRun:
        self._service.ready_motion()
        self._service.look()
        job = self._service.active_job
        if job is None:
            raise ApiError("no_job", "no job is on its way; job.start begins one")
        return job

    def _uncancelled(self) -> JobRun:
        job = self._active()
        if job.phase is JobPhase.CANCELLING:
            raise ApiError("busy", f"{job.file} is being cancelled")
        return job

    def _status(self) -> Value:
        self._service.look()
        return job_figures(self._service.job, self._service.now_s)


def _pictures(folder: JobFolder, name: str) -> list[Thumbnail]:
    """Return the pictures in the file NAME of FOLDER; raises NoSuchJob."""
    return thumbnails(folder.head(name, HEAD_BYTES))


def _name(name: str) -> str:
    """Return the name of a job without a file; raises ApiError."""
    if not name.strip() or not name.isprintable():
        raise ApiError("bad_params", f"{shown(name)} is no name for a job; give some characters that print")
    return name


def job_methods(service: MachineService) -> Iterator[Method]:
    """Return them."""
    jobs = _Jobs(service)
    yield Method(
        "job.list",
        Scope.WATCH,
        f"List the g-code files of the job folder by name, at most {_LISTED_MAX} at once.",
        jobs.list,
        params=(Param("first", Kind.INT, "skip so many", required=False, default=0, low=0, high=FILES_MAX),),
        returns=(
            Param("files", Kind.LIST, "maps of name, size_bytes and modified_s (since the epoch)"),
            Param("count", Kind.INT, "of all files"),
        ),
    )
    yield Method(
        "job.start",
        Scope.OPERATE,
        "Print a file of the job folder; its modes begin as a program's do.",
        jobs.start,
        params=(Param("file", Kind.STR, "as job.list names it", high=PATH_BYTES_MAX),),
        returns=_JOB,
    )
    for name, call, sentence in (
        (
            "job.pause",
            jobs.pause,
            "Come to a standstill between two moves; what is planned (some 2 s) is carried out.",
        ),
        ("job.resume", jobs.resume, "Go on exactly where the job stands."),
        (
            "job.cancel",
            jobs.cancel,
            "End the job in order: what is planned is carried out, the machine stays ready.",
        ),
    ):
        yield Method(name, Scope.OPERATE, sentence, call, returns=_JOB)
    yield from _fed_methods(jobs)
    yield Method(
        "job.recover",
        Scope.OPERATE,
        "Go on with a job that was interrupted (job.interrupted_file), once all axes are homed.",
        jobs.recover,
        params=(
            Param("line", Kind.INT, "null: where it was", required=False, default=None, low=1),
            Param(
                "home",
                Kind.BOOL,
                "home what is not homed, but never Z towards the part: nobody has moved it since",
                required=False,
                default=False,
            ),
            Param(
                "z",
                Kind.FLOAT,
                "with home: where the head stands; null: as it was written down",
                "mm",
                required=False,
                default=None,
            ),
        ),
        returns=_JOB,
    )
    yield Method(
        "job.history",
        Scope.WATCH,
        f"Return the last {HISTORY_MAX} jobs that ended, the newest first.",
        jobs.history,
        returns=(
            Param(
                "jobs",
                Kind.LIST,
                "maps of file, state (done, cancelled, failed, stopped), message (why), ended_s (since the"
                " epoch), elapsed_s (with pauses), print_time_s (without), filament_mm (drawn in)",
            ),
        ),
    )
    yield Method(
        "job.thumbnail",
        Scope.WATCH,
        "Return the largest picture that fits from the comments a slicer wrote at the begin of a file.",
        jobs.thumbnail,
        params=(
            Param("file", Kind.STR, "as job.list names it", high=PATH_BYTES_MAX),
            Param(
                "pixels_max", Kind.INT, "of its longer side", required=False, default=300, low=1, high=9999
            ),
        ),
        returns=(
            Param("width", Kind.INT, "null: the file has no picture that fits", "pixels"),
            Param("height", Kind.INT, "likewise", "pixels"),
            Param("png", Kind.STR, "in base64; null likewise"),
        ),
    )
    yield Method(
        "job.status", Scope.WATCH, "Return the progress of the job, or its result.", jobs.status, returns=_JOB
    )


def _fed_methods(jobs: _Jobs) -> Iterator[Method]:
    name = Param("name", Kind.STR, "of the job, for people", high=NAME_MAX)
    yield Method(
        "job.stream",
        Scope.OPERATE,
        "Print lines that job.feed brings, however many; answers when the job is over. When its client"
        " leaves, what came is carried out, and the job fails.",
        jobs.stream,
        params=(name,),
        returns=_JOB,
    )
    yield Method(
        "job.feed",
        Scope.OPERATE,
        "Bring lines to the job of job.stream; answers when there is room for the next, so wait for that.",
        jobs.feed,
        params=(
            name,
            Param("first_line", Kind.INT, "number of the first line of text; the job's first is 1", low=1),
            Param("text", Kind.STR, "whole lines", high=PIECE_BYTES_MAX),
            Param("end", Kind.BOOL, "these were the last", required=False, default=False),
            Param(
                "failure",
                Kind.STR,
                "why no more lines can come: the job fails when all that came is carried out",
                required=False,
                default=None,
                high=FAILURE_MAX,
            ),
        ),
        returns=(Param("lines", Kind.INT, "that came so far"),),
    )

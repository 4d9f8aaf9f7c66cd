"""[virtual_sdcard]: the job folder as a memory card: SDCARD_PRINT_FILE, M20 to M27."""

from collections.abc import Callable, Mapping, Sequence
from typing import Final

from coordinator.config.options import GCodeOption, SectionSpec, TextOption
from coordinator.gcode.commands import (
    Call,
    Immediate,
    ProgramAction,
    ProgramContext,
    Reading,
    Recovering,
)
from coordinator.gcode.parameters import bounded, flag, needed
from coordinator.gcode.parser import WordError
from coordinator.gcode.reply_kinds import ReplyKind
from coordinator.modules.base import Build, Module
from coordinator.modules.programs.gcode_macro import GCodeTemplate
from coordinator.modules.status.print_stats import PrintStats
from coordinator.support.values import Value
from nodes.support.errors import CanductorError

PATH = TextOption(
    name="path",
    help="The job folder, where none is given on the command line; relative to the configuration, ~ is your"
    " home",
)
ON_ERROR = GCodeOption(
    name="on_error_gcode", help="g-code to run when a line of a job cannot be carried out", default=""
)
_BUSY: Final = "a job is active; wait for its end, or cancel it"


class VirtualSdcard(Module):
    """Its commands; the service has the files."""

    SPEC = SectionSpec("Files that are printed", (PATH, ON_ERROR), unsupported=("with_subdirs",))

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.path = build.path(PATH)
        self.on_error = GCodeTemplate(build, ON_ERROR)
        self.acts_on_error = bool(build.get(ON_ERROR).strip())
        self.files: Callable[[], Sequence[tuple[str, int]]] = tuple
        """Returns names and sizes of the files; by the service. Raises CanductorError."""
        self.check: Callable[[str], None] = lambda _name: None
        """Looks whether there is a file of this name; by the service. Raises CanductorError."""
        self.place: Mapping[str, Value] = {"file_position": 0, "file_size": 0, "progress": 0.0}
        """How far the job is read; by the service."""
        self._stats = build.shared(PrintStats)
        self._selected = ""
        for name, help_, read, while_printing in (
            ("SDCARD_PRINT_FILE", "Print the file FILENAME", self._print, False),
            ("SDCARD_RESET_FILE", "Clear the selected file", self._reset, False),
            ("M20", "List the files", self._list, False),
            ("M21", "Report that files can be printed", self._init, True),
            ("M23", "Select a file", self._select, False),
            ("M24", "Print the selected file, or resume the paused job", self._start, True),
            ("M25", "Pause the job", self._pause, True),
            ("M26", "Set where to begin in the file: only S0, its begin", self._seek, False),
            ("M27", "Report how much of the job is read", self._report, True),
            ("RESUME_INTERRUPTED", "Resume a job that was interrupted by a crash", self._recover, False),
            ("_ON_ERROR_GCODE", "Run on_error_gcode", self._failed, False),
        ):
            build.add_command(name, help_, read, while_printing=while_printing)

    def status(self) -> Mapping[str, Value]:
        """Report which file is printed, and how far it is read."""
        name = self._stats.job["filename"] or None
        return {
            **self.place,
            "file_path": name,
            "is_active": self._stats.state == "printing",
        }

    def _print(self, call: Call) -> Reading:
        values = call.parameters("FILENAME")
        name = needed(call.command, values, "FILENAME").lstrip("/")
        return ProgramAction(lambda job: self._begin(job, name))

    def _begin(self, job: ProgramContext, name: str) -> bool:
        prints = job.prints
        if prints is None:
            job.notice("printing a file", "only a service (canductor run) prints files: it is skipped")
            return True
        if prints.job_is_active:
            raise WordError(_BUSY)
        self._check(name)
        prints.start_job(name)
        return True

    def _check(self, name: str) -> None:
        try:
            self.check(name)
        except CanductorError as error:
            raise WordError(str(error)) from None

    def _reset(self, call: Call) -> Reading:
        call.parameters()

        def act(job: ProgramContext) -> bool:
            if job.prints is not None and job.prints.job_is_active:
                raise WordError(_BUSY)
            self._selected = ""
            self._stats.forget()
            return True

        return ProgramAction(act)

    def _list(self, _call: Call) -> Reading:
        try:
            files = [f"{name} {size}" for name, size in self.files()]
        except CanductorError as error:
            raise WordError(str(error)) from None
        return Immediate(("Begin file list", *files, "End file list"), kind=ReplyKind.PLAIN)

    def _init(self, _call: Call) -> Reading:
        return Immediate(("SD card ok",), kind=ReplyKind.PLAIN)

    def _select(self, call: Call) -> Reading:
        name = call.command.text.split(";")[0].strip().lstrip("/")
        if not name:
            raise WordError("M23 names no file; write M23 and its name")
        self._check(name)

        def act() -> None:
            self._selected = name

        return Immediate((f"File selected: {name}",), act, kind=ReplyKind.PLAIN)

    def _start(self, _call: Call) -> Reading:
        def act(job: ProgramContext) -> bool:
            if job.prints is not None and job.prints.job_is_active:
                job.prints.resume_job()
                return True
            if not self._selected:
                raise WordError("M24 comes before a file is selected; select one with M23")
            return self._begin(job, self._selected)

        return ProgramAction(act)

    def _pause(self, _call: Call) -> Reading:
        def act(job: ProgramContext) -> bool:
            if job.prints is not None:
                job.prints.pause_job(job)
            return True

        return ProgramAction(act)

    def _seek(self, call: Call) -> Reading:
        if call.command.words("S").get("S", "0") not in {"", "0"}:
            raise WordError(
                "M26 cannot begin in the middle of a file: temperatures, modes and origin would be missing;"
                " RESUME_INTERRUPTED goes on with one"
            )
        return Immediate()

    def _report(self, _call: Call) -> Reading:
        if self._stats.state not in ("printing", "paused"):
            return Immediate(("Not SD printing.",), kind=ReplyKind.PLAIN)
        place = self.place
        return Immediate(
            (f"SD printing byte {place['file_position']}/{place['file_size']}",), kind=ReplyKind.PLAIN
        )

    def _recover(self, call: Call) -> Reading:
        values = call.parameters("LINE", "HOME", "Z")
        line = bounded(call.command, values, "LINE", None, low=1, high=1e9)
        z_mm = bounded(call.command, values, "Z", None, low=-1e6, high=1e6)
        how = Recovering(None if line is None else int(line), flag(call.command, values, "HOME"), z_mm)

        def act(job: ProgramContext) -> bool:
            if job.prints is None:
                job.notice("RESUME_INTERRUPTED", "only a service (canductor run) keeps a journal of jobs")
            elif job.prints.job_is_active:
                raise WordError(_BUSY)
            else:
                job.prints.recover_job(how)
            return True

        return ProgramAction(act)

    def _failed(self, call: Call) -> Reading:
        return self.on_error.lines(call, {})

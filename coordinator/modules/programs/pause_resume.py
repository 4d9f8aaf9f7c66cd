"""[pause_resume]: PAUSE, RESUME, CANCEL_PRINT and CLEAR_PAUSE, from the job itself or from a client.

PAUSE remembers where the job stands; what its macro does afterwards (parking, drawing filament back) comes
behind that. RESUME goes back there and lets the job go on.
"""

from collections.abc import Mapping
from typing import Final

from coordinator.config.options import FloatOption, SectionSpec
from coordinator.gcode.builtins.state import save_state
from coordinator.gcode.commands import Call, ProgramAction, ProgramContext, Reading
from coordinator.gcode.events import Reply
from coordinator.gcode.parameters import bounded
from coordinator.modules.base import Build, Module
from coordinator.modules.status.print_stats import PrintStats
from coordinator.support.values import Value

VELOCITY = FloatOption(
    name="recover_velocity",
    help="Speed at which RESUME moves back, unless it has a VELOCITY",
    default=50.0,
    unit="mm/s",
    above=0.0,
    maximum=10_000.0,
)
STATE: Final = "PAUSE_STATE"
"""The name under which PAUSE saves the state, for macros."""


class PauseResume(Module):
    """The commands."""

    SPEC = SectionSpec("Pause and resume a job by g-code", (VELOCITY,))

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._velocity_mm_s = build.get(VELOCITY)
        self._paused = False
        """Whether PAUSE was given, and neither RESUME nor an end of the job since."""
        build.shared(PrintStats)
        for name, help_, read in (
            ("PAUSE", "Pause the job", self._pause),
            ("RESUME", "Move back to where the job was paused and resume it", self._resume),
            ("CANCEL_PRINT", "Cancel the job", self._cancel),
            ("CLEAR_PAUSE", "Clear the paused state without resuming", self._clear),
        ):
            build.add_command(name, help_, read, while_printing=True)

    def status(self) -> Mapping[str, Value]:
        """Report whether there is a pause."""
        return {"is_paused": self._paused}

    def job_begins(self) -> None:
        """Forget a pause of another job."""
        self._paused = False

    def resumed(self) -> None:
        """Record that the job goes on, whatever resumed it."""
        self._paused = False

    def _pause(self, call: Call) -> Reading:
        call.parameters()

        def act(job: ProgramContext) -> bool:
            if self._paused and (job.prints is None or job.prints.paused):
                job.emit(Reply(job.line, "the job is paused already"))
                return True
            save_state(job, STATE)
            self._paused = True
            if job.prints is not None:
                job.prints.pause_job(job)
            else:
                job.notice("PAUSE", "there is no job to pause: only a service (canductor run) has jobs")
            return True

        return ProgramAction(act)

    def _resume(self, call: Call) -> Reading:
        values = call.parameters("VELOCITY")
        speed = bounded(call.command, values, "VELOCITY", self._velocity_mm_s, low=0.001, high=10_000.0)

        def act(job: ProgramContext) -> bool:
            prints = job.prints
            if not self._paused and (prints is None or not prints.paused):
                job.emit(Reply(job.line, "nothing is paused: RESUME does nothing"))
                return True
            if prints is not None and not job.while_printing and not prints.come_back(job, speed):
                return False
            self._paused = False
            if prints is not None:
                prints.resume_job()
            return True

        return ProgramAction(act)

    def _cancel(self, call: Call) -> Reading:
        call.parameters()

        def act(job: ProgramContext) -> bool:
            self._paused = False
            if job.prints is not None:
                job.prints.cancel_job(job)
            return True

        return ProgramAction(act)

    def _clear(self, call: Call) -> Reading:
        call.parameters()

        def act(_job: ProgramContext) -> bool:
            self._paused = False
            return True

        return ProgramAction(act)

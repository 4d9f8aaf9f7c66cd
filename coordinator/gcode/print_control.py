"""What a program may do about the job, its own or that which another one prints."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from coordinator.gcode.interpreter import Job


@dataclass(frozen=True, slots=True)
class Recovering:
    """How an interrupted job is to go on."""

    line: int | None = None
    """None: where it was."""
    home: bool = False
    """Whether to home what is not homed, as far as the part is not in the way."""
    z_mm: float | None = None
    """Where the head stands in Z, in the machine's frame; None: as it was written down."""


class PrintControl(Protocol):
    """Has at most one job at a time. All is called in the reader's thread and never waits."""

    @property
    def job_is_active(self) -> bool:
        """Whether there is a job that is neither done nor cancelled."""
        ...

    @property
    def paused(self) -> bool:
        """Whether the job is to read no further."""
        ...

    def pause_job(self, program: "Job") -> None:
        """Let the job read no further, by a line of PROGRAM; that goes on to the end of the line.

        Where the program stands is where the job will go on.
        """

    def come_back(self, program: "Job", speed_mm_s: float) -> bool:
        """Go to where the job was paused, as PROGRAM's next moves; False: with the planner emptied, again.

        Raises WordError when that is not possible.
        """
        ...

    def resume_job(self) -> None:
        """Let the job go on when the program at hand has ended."""

    def cancel_job(self, program: "Job") -> None:
        """End the job, by a line of PROGRAM; that goes on to the end of the line."""

    def start_job(self, name: str) -> None:
        """Print the file NAME of the job folder when the program at hand has ended."""

    def recover_job(self, how: Recovering) -> None:
        """Go on with the interrupted job when the program at hand has ended."""

"""What a service does for modules. There is none where a file is run or a program is planned."""

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol


class Runner(Protocol):
    """Runs g-code for modules; on the control loop."""

    @property
    def busy(self) -> bool:
        """Whether there is a job that is not paused, or anything moves, dwells or waits.

        Lines that only answer or set something do not either, however often they come.
        """
        ...

    @property
    def moved(self) -> int:
        """How many jobs, lines of clients and the like have moved anything so far."""
        ...

    @property
    def paused(self) -> bool:
        """Whether there is a job that is paused."""
        ...

    def run_lines(
        self, name: str, lines: Sequence[str], text: str = "", *, on_end: Callable[[], None] = ...
    ) -> None:
        """Run g-code LINES as those of a client; NAME is for messages. Errors are logged.

        TEXT is what they stand for: a job is paused first if there are words in it that pause or cancel one.
        ON_END is called when they have ended, in whatever way, unless the machine stops or restarts.
        """

    def live_motion(self) -> tuple[Sequence[float], float, float] | None:
        """Return where the head is now (X Y Z E, mm), and the speeds of head and filament, mm/s.

        None: nothing moves it yet.
        """
        ...

    @property
    def remote_methods(self) -> frozenset[str]:
        """Names of the methods that clients have registered for programs to call; from any thread."""
        ...

    def call_remote(self, name: str, values: Mapping[str, object]) -> None:
        """Call every client that registered the method NAME, with VALUES."""

    def run_paused(self, name: str, lines: Sequence[str], *, stay: bool) -> None:
        """Run LINES with the job paused, if there is one: they may move.

        The job resumes after them, unless they have paused it; with STAY it stays paused.
        """

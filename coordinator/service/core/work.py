"""What clients can have the machine do: g-code lines, single moves, a job's file.

A work is stepped in the motion worker's thread, where the planner may be touched; the control loop only makes
it and is notified of its end.
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from coordinator.gcode.commands import PrintControl, Vocabulary
from coordinator.gcode.events import End, Event, Full, Idle, Progress
from coordinator.gcode.interpreter import Job
from coordinator.gcode.machine_state import MachineState
from coordinator.gcode.parser import WordError, parse
from coordinator.gcode.program import Program
from coordinator.motion.planner.planner import AXIS_LETTERS, FeedStatus, Planner
from nodes.support.errors import CanductorError

LINES_MAX: Final = 500
"""Lines a client may send at once: they are looked through on the control loop, in some 2 ms."""
LINES_BYTES_MAX: Final = 32_768
EMERGENCY: Final = "M112"
_EMERGENCY_LINE: Final = re.compile(
    r"(?:^|(?<=\r))[ \t]*(?:N\d+[ \t]*)?M112\b", re.ASCII | re.IGNORECASE | re.MULTILINE
)
"""Within one line: a search looks at each line once, however many there are."""


class WorkError(CanductorError):
    """A work that cannot be carried out; what came before it in the same work is."""


@dataclass(frozen=True, slots=True)
class Setting:
    """What every work acts on."""

    planner: Planner
    machine: MachineState
    homed_position: Mapping[str, float]
    vocabulary: Vocabulary
    prints: PrintControl | None = None
    """Control of the job for programs; None: the program that is read is all there is."""

    def job(self, program: Program, *, while_printing: bool = False) -> Job:
        """Return what reads PROGRAM; WHILE_PRINTING: between two lines of a job that prints."""
        return Job(
            program,
            self.planner,
            self.homed_position,
            self.machine,
            self.vocabulary,
            while_printing=while_printing,
            prints=self.prints,
            strict=self.prints is not None,
        )


class Rest(Enum):
    """How a work ends."""

    STANDSTILL = "standstill"
    """With all its moves planned to a standstill."""
    OPEN = "open"
    """As soon as it is read: the next work's moves may join without a stop."""


NO_PROGRESS: Final = Progress(0, 0, None)


@dataclass(slots=True)
class Work(ABC):
    """One thing to do; ``step`` answers as a job's does and End when all is read."""

    _job: Job | None = field(default=None, init=False)
    """Reads the work's program, once it is begun; None also for a work without a program."""

    @property
    @abstractmethod
    def name(self) -> str:
        """For messages."""

    @property
    @abstractmethod
    def rest(self) -> Rest:
        """How it ends."""

    @abstractmethod
    def begin(self, setting: Setting) -> None:
        """Get ready; before the first step."""

    @abstractmethod
    def step(self) -> Event:
        """Go on; raises CanductorError when it cannot."""

    def pending(self) -> Event | None:
        """Return the next event of what was done so far; raises CanductorError."""
        return None if self._job is None else self._job.pending()

    @property
    def settled(self) -> bool:
        """Whether no event and no result is pending."""
        return self._job is None or self._job.settled

    @property
    def at_line(self) -> bool:
        """Whether it stands between two lines."""
        return self._job is None or self._job.at_line

    def progress(self) -> Progress:
        """Return how far it is read."""
        return NO_PROGRESS

    def close(self) -> None:
        """Release what it holds."""
        if self._job is not None:
            self._job.close()


class _Text:
    """Text that was sent, as a source that ends in waiting: what has no end needs no standstill there."""

    def __init__(self, data: bytes) -> None:
        self._data: bytes | None = data

    def read(self, _size: int, /) -> bytes | None:
        data, self._data = self._data, None
        return data

    def close(self) -> None:
        """Nothing to release."""


@dataclass(slots=True)
class LinesWork(Work):
    """G-code LINES of a client, in the modes that the lines before them left."""

    lines: Sequence[str]
    name: str = "client"
    rest: Rest = Rest.STANDSTILL
    while_printing: bool = False
    """Whether they come between two lines of a job that prints: then none of them may move."""

    def begin(self, setting: Setting) -> None:
        """Read the lines as a program of its own."""
        text = "".join(line.rstrip("\r\n") + "\n" for line in self.lines)
        program = Program(_Text(text.encode(errors="replace")), self.name, size_bytes=None)
        setting.planner.lines = 0
        self._job = setting.job(program, while_printing=self.while_printing)

    def step(self) -> Event:
        """Go on."""
        assert self._job is not None
        event = self._job.step()
        return End(self._job.planner.lines, 0.0) if isinstance(event, Idle) else event


@dataclass(slots=True)
class FileWork(Work):
    """A job's PROGRAM, which begins in the modes that a program begins in, and leaves them so."""

    program: Program
    rest: Rest = Rest.STANDSTILL

    @property
    def name(self) -> str:
        """The file."""
        return self.program.name

    def begin(self, setting: Setting) -> None:
        """Begin at the first line."""
        setting.planner.reset_modes()
        setting.planner.lines = 0
        self._job = setting.job(self.program)

    def step(self) -> Event:
        """Go on."""
        assert self._job is not None
        return self._job.step()

    def progress(self) -> Progress:
        """Return how far the file is read."""
        lines = 0 if self._job is None else self._job.planner.lines
        return Progress(lines, self.program.done_bytes, self.program.size_bytes)

    def close(self) -> None:
        """Close the file; the modes of what follows are not this job's, nor is its tower."""
        if self._job is not None:
            self._job.close()
            self._job.planner.reset_modes()
            self._job.machine.tower = None
            self._job.planner.watch_height(None)
        self.program.close()


@dataclass(slots=True)
class MoveWork(Work):
    """One straight move in the machine's frame: AXES (letter to mm), from where it is when RELATIVE."""

    axes: Mapping[str, float]
    speed_mm_s: float
    relative: bool
    name: str = "move"
    rest: Rest = Rest.STANDSTILL
    _planner: Planner | None = None
    target: list[float] = field(default_factory=list)
    """X Y Z E, once it is begun."""

    def begin(self, setting: Setting) -> None:
        """Take where the machine will be."""
        self._planner = setting.planner
        self.target = list(setting.planner.toolhead_position)
        for letter, value in self.axes.items():
            axis = AXIS_LETTERS.index(letter)
            self.target[axis] = value + (self.target[axis] if self.relative else 0.0)

    def step(self) -> Event:
        """Plan it."""
        assert self._planner is not None
        status = self._planner.move_to(self.target, self.speed_mm_s)
        if status is FeedStatus.FULL:
            return Full()
        if status is FeedStatus.LIMIT:
            raise WorkError(str(self._planner.fault))
        return End(0, 0.0)


def has_emergency(script: str) -> bool:
    """Return whether SCRIPT has a line with M112, whatever its other lines are."""
    return EMERGENCY in script.upper() and _EMERGENCY_LINE.search(script) is not None


def commands_in(lines: Sequence[str]) -> list[str]:
    """Return the names of the commands in LINES; raises WorkError for a line that cannot be read."""
    names = []
    for number, line in enumerate(lines, 1):
        try:
            command = parse(line.encode(errors="replace"))
        except WordError as problem:
            raise WorkError(f"line {number}: {problem}") from None
        if command is not None:
            names.append(command.name)
    return names

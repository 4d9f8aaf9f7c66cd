"""Commands that modules add to the language of programs, what reading one returns, and what they act on.

``read`` runs as soon as the line is read, in the reader's thread, also when a program is only planned: it
checks the parameters (WordError) and returns what is to be done and when. It changes nothing itself.

=============  ==============================================================================================
Immediate      is done when it is read: a reply, or a value for the lines to come
Synchronized   is done when the moves before it are carried out, without stopping them: a fan
ProgramAction  acts on the program that reads it: on its modes, on where its moves go
AtStandstill   is done at standstill, and the program waits for it: a heater to become hot, homing
Lines          is replaced by other lines: a macro
BuiltIn        is the interpreter's own command of another name: one whose name a macro has taken
Phases         are several of these in turn, each of which may depend on the results of those before
=============  ==============================================================================================
"""

from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

from coordinator.gcode.events import Done, Event
from coordinator.gcode.machine_state import MachineState
from coordinator.gcode.parser import Command
from coordinator.gcode.reply_kinds import ReplyKind
from coordinator.gcode.status import Figures
from coordinator.motion.planner.planner import Planner
from coordinator.motion.steps.surface import Surface

Position = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Call:
    """One command as it is read."""

    command: Command
    line: int
    """Of the program."""
    position: Position
    """Where the moves before it lead the motors, in the machine's frame and with the shape of the bed; mm."""
    homed: str
    """Letters of the axes that are homed then."""
    callers: tuple[str, ...] = ()
    """Names of the replaced commands that it stands in, the outermost first."""
    extruder: str = ""
    """The active extruder; empty where there is none."""
    figures: Callable[[], Figures] = dict
    """Return ``toolhead`` and ``gcode_move`` as they are there (gcode/status.py)."""
    while_printing: bool = False
    """Whether a client gives it while a job prints, which must not wait for it."""

    def parameters(self, *known: str) -> dict[str, str]:
        """Read NAME=VALUE parameters, of which KNOWN are the names, others are ignored; raises WordError."""
        return self.command.only_parameters(known)


@dataclass(frozen=True, slots=True)
class Immediate:
    """Act now, if there is anything to do, and answer REPLIES."""

    replies: tuple[str, ...] = ()
    act: Callable[[], None] | None = None
    """Quick, in the reader's thread, also when a program is only planned."""
    kind: ReplyKind = ReplyKind.INFORMATION
    """Of the replies."""


@dataclass(frozen=True, slots=True)
class Synchronized:
    """ACT is called on the control loop, ahead of the print time (s) at which it is to take effect."""

    act: Callable[[float], None]


@dataclass(frozen=True, slots=True)
class AtStandstill:
    """PERFORM runs on the control loop while the machine stands; it may be cancelled."""

    perform: Callable[[], Awaitable[Done | None]]
    planned: Done | None = None
    """What a program that is only planned takes for granted."""


@dataclass(frozen=True, slots=True)
class Lines:
    """TEXT takes the command's place; before that, REPLIES are given."""

    text: str
    replies: tuple[str, ...] = ()
    where: Callable[[int], str] | None = None
    """Names the place that a line of the text (from 1) comes from, for messages."""


@dataclass(frozen=True, slots=True)
class ProgramAction:
    """ACT changes what holds for the program's lines to come; False: with the planner emptied, once more.

    It is called in the reader's thread, also when a program is only planned; raises WordError.
    """

    act: "Callable[[ProgramContext], bool]"


@dataclass(frozen=True, slots=True)
class BuiltIn:
    """The interpreter's own command of NAME acts."""

    name: str


@dataclass(frozen=True, slots=True)
class Phases:
    """Follow the readings that RUN yields for the program; the next is made when the one before is over.

    RUN goes on in the reader's thread and may raise WordError. Where a program is only planned, what is done
    at standstill never happens: RUN has to end when it finds that nothing came of it. A generator is closed
    when the program ends before it, by an error of what it yielded or because it was cancelled.
    """

    run: "Callable[[ProgramContext], Iterator[Reading]]"


Reading = Immediate | Synchronized | AtStandstill | Lines | ProgramAction | BuiltIn | Phases


@dataclass(frozen=True, slots=True)
class GCodeCommand:
    """A command of NAME (``M104``, ``SET_FAN_SPEED``)."""

    name: str
    help: str
    """One sentence, without a full stop."""
    read: Callable[[Call], Reading]
    while_printing: bool = False
    """Whether a client may give it while a job prints, between two lines of the job: it neither moves nor
    waits."""


def renamed(command: GCodeCommand | None, name: str, rename: str, *, while_printing: bool) -> GCodeCommand:
    """Return what NAME was, under another name: COMMAND, or without one the interpreter's own.

    WHILE_PRINTING: whether that one may be given while a job prints.
    """
    if command is None:
        return GCodeCommand(
            rename, f"What {name} is by itself", lambda _: BuiltIn(name), while_printing=while_printing
        )

    def read(call: Call) -> Reading:
        return command.read(replace(call, command=call.command.called(name)))

    return GCodeCommand(rename, command.help, read, while_printing=command.while_printing)


@dataclass(frozen=True, slots=True)
class Vocabulary:
    """What the machine's modules make of a program's words."""

    commands: Mapping[str, GCodeCommand]
    """By name; they come before the interpreter's own."""
    home: Callable[[Call, str], Reading] | None = None
    """Reads G28 with the letters of the axes; None: there is nothing to look for."""
    too_cold: Callable[[str], bool] = lambda _extruder: False
    """Whether an extruder must not move filament now; asked before each piece of a program, in the reader's
    thread. One that is only planned is never too cold."""
    z_shift: Callable[[float], float] | None = None
    """Return by how much Z has to be higher for what is planned next at that Z, mm; asked as ``too_cold``."""
    interrupting: frozenset[str] = frozenset()
    """Commands that may pause or cancel a job: PAUSE, CANCEL_PRINT, and macros in which they come."""
    disturbing: frozenset[str] = frozenset()
    """Commands that a job has to stand still for between two of its lines, and macros in which they come."""
    unsupported: Mapping[str, str] = field(default_factory=dict)
    """Why, by the name of a command that a section of the configuration should bring, nothing acts on it:
    ``[bed_mesh] is not supported yet``."""
    set_ups: "tuple[Callable[[Planner], None], ...]" = ()
    """Called for every program that begins."""
    surface: Surface | None = None
    """The shape of the bed that Z follows from the start; None: a plane."""


NO_WORDS = Vocabulary({})


# ---- What commands act on ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Recovering:
    """How an interrupted job is resumed."""

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

    def pause_job(self, program: "ProgramContext") -> None:
        """Pause the job, by a line of PROGRAM, which continues to the end of the line.

        Where the program stands is where the job will go on.
        """

    def come_back(self, program: "ProgramContext", speed_mm_s: float) -> bool:
        """Go to where the job was paused, as PROGRAM's next moves; False: with the planner emptied, again.

        Raises WordError when that is not possible.
        """
        ...

    def resume_job(self) -> None:
        """Resume the job when the present program has ended."""

    def cancel_job(self, program: "ProgramContext") -> None:
        """Cancel the job, by a line of PROGRAM, which continues to the end of the line."""

    def start_job(self, name: str) -> None:
        """Print the file NAME of the job folder when the present program has ended."""

    def recover_job(self, how: Recovering) -> None:
        """Resume the interrupted job when the present program has ended."""


class ProgramContext(ABC):
    """The program that is being read, as its commands see it; the interpreter's Job."""

    planner: Planner
    machine: MachineState
    """What the program may change; it is changed in place."""
    vocabulary: Vocabulary
    homed_position: Mapping[str, float]
    """Where each axis (letter) stands after G28, mm; these are the axes that exist."""
    while_printing: bool
    """Whether its lines come between those of a job that prints: then only some are carried out."""
    prints: PrintControl | None
    """Controls the jobs; None: there are none, this program is all there is."""

    @property
    @abstractmethod
    def line(self) -> int:
        """Number of the line that comes next, or is being carried out."""

    @abstractmethod
    def emit(self, event: Event) -> None:
        """Return EVENT from the next ``step``."""

    @abstractmethod
    def notice(self, what: str, remark: str) -> None:
        """Report WHAT with a remark, once per program."""

    @abstractmethod
    def refuse_skipping(self, command: Command, why: str) -> None:
        """Raise WordError for a COMMAND that a job must not go without; a plan only reports it.

        WHY: what it does, and why nothing does it here.
        """

    @abstractmethod
    def call(self, command: Command) -> Call:
        """Return COMMAND with what holds where it stands."""

    @abstractmethod
    def knows(self, name: str) -> bool:
        """Whether NAME is a command."""

    @abstractmethod
    def follow(self, command: Command, reading: Reading) -> bool:
        """Do what READING says; False: the planner has to be emptied first."""

    @abstractmethod
    def take(self, done: Done) -> None:
        """Take over what was done at standstill."""

    @abstractmethod
    def break_after_line(self) -> None:
        """Make ``step`` return as soon as the present line is done, with all lines that replace it."""

    @abstractmethod
    def end_with(self, event: Event) -> None:
        """End the program with EVENT."""

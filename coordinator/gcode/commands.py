"""Commands that modules add to the language of programs, and what comes of reading one.

``read`` runs as soon as the line is read, in the reader's thread, also when a program is only planned: it
checks the parameters (WordError) and returns what is to be done and when. It changes nothing itself.

===========  ================================================================================================
AtOnce       is done when it is read: an answer, or a value for the lines to come
InTime       is done when the moves before it are carried out, without stopping them: a fan
ToProgram    acts on the program that reads it: on its modes, on where its moves go
AtRest       is done when the machine stands, and the program waits for it: a heater to become hot, homing
Lines        is replaced by other lines: a macro
BuiltIn      is what the interpreter makes of another name: a command that a macro has taken the name of
===========  ================================================================================================
"""

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from coordinator.gcode.parser import Command
from coordinator.gcode.reply_kinds import ReplyKind
from coordinator.motion.planner.planner import Planner

if TYPE_CHECKING:
    from coordinator.gcode.interpreter import Job
Position = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Call:
    """One command as it is read."""

    command: Command
    line: int
    """Of the program."""
    position: Position
    """Where the moves before it lead to, in the machine's frame; X Y Z E, mm."""
    homed: str
    """Letters of the axes that are homed then."""
    callers: tuple[str, ...] = ()
    """Names of the replaced commands that it stands in, the outermost first."""
    extruder: str = ""
    """The active extruder; empty where there is none."""
    figures: Callable[[], Mapping[str, Mapping[str, object]]] = dict
    """Tells ``toolhead`` and ``gcode_move`` as they are there (gcode/figures.py)."""
    beside: bool = False
    """Whether a client gives it while a job prints, which must not wait for it."""

    def parameters(self, *known: str) -> dict[str, str]:
        """Read NAME=VALUE parameters, of which KNOWN are the names, others are ignored; raises WordError."""
        return self.command.only_parameters(known)


@dataclass(frozen=True, slots=True)
class Done:
    """What came of something that was done at rest."""

    replies: tuple[str, ...] = ()
    position: Position | None = None
    """Where the machine stands now, if that is new; X Y Z E, mm."""
    homed: str = ""
    """Letters of the axes that ``position`` makes known."""
    unhomed: str = ""
    """Letters of the axes whose place is not known any more."""
    moved: bool = False
    """Whether steppers were moved past the program's own moves."""
    second_carriage_mm: float | None = None
    """Where the second carriage was homed; None: where the configuration says."""
    kind: ReplyKind = ReplyKind.INFORMATION
    """Of the replies."""


@dataclass(frozen=True, slots=True)
class AtOnce:
    """Act now, if there is anything to do, and answer REPLIES."""

    replies: tuple[str, ...] = ()
    act: Callable[[], None] | None = None
    """Quick, in the reader's thread, also when a program is only planned."""
    kind: ReplyKind = ReplyKind.INFORMATION
    """Of the replies."""


@dataclass(frozen=True, slots=True)
class InTime:
    """ACT is called on the control loop, ahead of the print time (s) at which it is to take effect."""

    act: Callable[[float], None]


@dataclass(frozen=True, slots=True)
class AtRest:
    """PERFORM runs on the control loop while the machine stands; it may be cancelled."""

    perform: Callable[[], Awaitable[Done | None]]
    planned: Done | None = None
    """What a program that is only planned takes for granted."""


@dataclass(frozen=True, slots=True)
class Lines:
    """TEXT takes the command's place; before that, REPLIES are told."""

    text: str
    replies: tuple[str, ...] = ()
    where: Callable[[int], str] | None = None
    """Names the place that a line of the text (from 1) comes from, for messages."""


@dataclass(frozen=True, slots=True)
class ToProgram:
    """ACT changes what holds for the program's lines to come; False: with the planner emptied, once more.

    It is called in the reader's thread, also when a program is only planned; raises WordError.
    """

    act: "Callable[[Job], bool]"


@dataclass(frozen=True, slots=True)
class BuiltIn:
    """The interpreter's own command of NAME acts."""

    name: str


Reading = AtOnce | InTime | AtRest | Lines | ToProgram | BuiltIn


@dataclass(frozen=True, slots=True)
class GCodeCommand:
    """A command of NAME (``M104``, ``SET_FAN_SPEED``)."""

    name: str
    help: str
    """One sentence, without a full stop."""
    read: Callable[[Call], Reading]
    beside: bool = False
    """Whether a client may give it while a job prints, between two lines of the job: it neither moves nor
    waits."""


def renamed(command: GCodeCommand | None, name: str, rename: str, *, beside: bool) -> GCodeCommand:
    """Return what NAME was, under another name: COMMAND, or without one the interpreter's own.

    BESIDE: whether that one may be given beside a job.
    """
    if command is None:
        return GCodeCommand(rename, f"What {name} is by itself", lambda _: BuiltIn(name), beside=beside)

    def read(call: Call) -> Reading:
        return command.read(replace(call, command=call.command.called(name)))

    return GCodeCommand(rename, command.help, read, beside=command.beside)


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
    interrupting: frozenset[str] = frozenset()
    """Commands that may pause or cancel a job: PAUSE, CANCEL_PRINT, and macros in which they come."""
    disturbing: frozenset[str] = frozenset()
    """Commands that a job has to stand still for between two of its lines, and macros in which they come."""
    not_acting: Mapping[str, str] = field(default_factory=dict)
    """Why, by the name of a command that a section of the configuration should bring, nothing acts on it:
    ``[bed_mesh] does not act yet``."""
    set_ups: "tuple[Callable[[Planner], None], ...]" = ()
    """Called for every program that begins."""


NO_WORDS = Vocabulary({})

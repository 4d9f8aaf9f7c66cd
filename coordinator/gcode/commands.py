"""Commands that modules add to the language of programs, and what comes of reading one.

``read`` runs as soon as the line is read, in the reader's thread, also when a program is only planned: it
checks the parameters (WordError) and returns what is to be done and when. It changes nothing itself.

===========  ================================================================================================
AtOnce       is done when it is read: an answer, or a value for the lines to come
InTime       is done when the moves before it are carried out, without stopping them: a fan
AtRest       is done when the machine stands, and the program waits for it: a heater to become hot, homing
Lines        is replaced by other lines: a macro
===========  ================================================================================================
"""

from collections.abc import Awaitable, Callable, Mapping

from coordinator.gcode.words import Command, WordError, quoted
from nodes.records import record

Position = tuple[float, float, float, float]


@record
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

    def parameters(self, *known: str) -> dict[str, str]:
        """Read NAME=VALUE parameters, of which KNOWN are the names; raises WordError."""
        values = self.command.parameters()
        for key in values.keys() - set(known):
            takes = f"it takes {' '.join(known)}" if known else "it takes none"
            raise WordError(f"{self.command.name} has no parameter {quoted(key)}; {takes}")
        return values


@record
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


@record
class AtOnce:
    """Act now, if there is anything to do, and answer REPLIES."""

    replies: tuple[str, ...] = ()
    act: Callable[[], None] | None = None
    """Quick, in the reader's thread, also when a program is only planned."""


@record
class InTime:
    """ACT is called on the control loop, ahead of the print time (s) at which it is to take effect."""

    act: Callable[[float], None]


@record
class AtRest:
    """PERFORM runs on the control loop while the machine stands; it may be cancelled."""

    perform: Callable[[], Awaitable[Done | None]]
    planned: Done | None = None
    """What a program that is only planned takes for granted."""


@record
class Lines:
    """TEXT takes the command's place."""

    text: str


Reading = AtOnce | InTime | AtRest | Lines


@record
class GCodeCommand:
    """A command of NAME (``M104``, ``SET_FAN_SPEED``)."""

    name: str
    help: str
    """One sentence, without a full stop."""
    read: Callable[[Call], Reading]


@record
class Vocabulary:
    """What the machine's modules make of a program's words."""

    commands: Mapping[str, GCodeCommand]
    """By name; they come before the interpreter's own."""
    home: Callable[[Call, str], Reading] | None = None
    """Reads G28 with the letters of the axes; None: there is nothing to look for."""
    too_cold: Callable[[str], bool] = lambda _extruder: False
    """Whether an extruder must not move filament now; asked before each piece of a program, in the reader's
    thread. One that is only planned is never too cold."""


NO_WORDS = Vocabulary({})

"""Events that a ``Job`` returns to its driver. Lines count from 1; print times are s (docs/architecture.md).

==============  ==========================================================================================
event           what the driver does before it calls ``step`` again
==============  ==========================================================================================
Progress        nothing
Idle            waits for input; plans what there is to a standstill before the machine runs dry
Full            takes and releases trapezoids (a streamer: waits until there is room, or raises plan_until_s)
Wait            takes all trapezoids; in real time, waits until PRINT_TIME_S has been executed
PositionSet     takes all trapezoids, then sets the position of step generation
ShaperChange,   takes all trapezoids, generates their steps up to PRINT_TIME_S with flush, then changes
WeightsChange,  step generation; the machine has been at rest for longer than every shaper and every
SmoothTime-     smoothing window is wide
Change, Surface-
Change
Timed           calls ACT with the print time at which the next move begins; continues meanwhile
Standstill-     takes all trapezoids; in real time, waits until PRINT_TIME_S has been executed, has it
Action          performed and keeps the result in the event
Reply, Notice   shows the text
Emergency       stops the machine at once; the job is over
End             takes all trapezoids; the job is over
==============  ==========================================================================================
"""

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass

from coordinator.gcode.reply_kinds import ReplyKind
from coordinator.motion.steps.surface import Surface
from nodes.support.terminal import printable_lines


@dataclass(frozen=True, slots=True)
class Done:
    """The result of an action at standstill."""

    replies: tuple[str, ...] = ()
    position: tuple[float, float, float, float] | None = None
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
class Progress:
    """A piece of the program was read, or some of its lines."""

    line: int
    done_bytes: int
    size_bytes: int | None
    """None where the length is not known."""


@dataclass(frozen=True, slots=True)
class Idle:
    """The program's source has nothing at present, but has not ended: someone is typing."""


@dataclass(frozen=True, slots=True)
class Full:
    """The planner has no room for the next line."""


@dataclass(frozen=True, slots=True)
class Wait:
    """M400: all moves are planned to a standstill that is reached at PRINT_TIME_S."""

    line: int
    print_time_s: float


@dataclass(frozen=True, slots=True)
class PositionSet:
    """G28: from PRINT_TIME_S the machine stands at POSITION (X Y Z E, mm); AXES (letters) were set.

    All earlier trapezoids end in the old position, all later ones begin in the new one.
    """

    line: int
    axes: str
    position: tuple[float, float, float, float]
    print_time_s: float


@dataclass(frozen=True, slots=True)
class ShaperChange:
    """SET_INPUT_SHAPER: from PRINT_TIME_S on AXIS (letter) is shaped so; FREQUENCY_HZ 0: not at all."""

    line: int
    axis: str
    kind: str
    """zv, mzv, zvd, ei, 2hump_ei or 3hump_ei."""
    frequency_hz: float
    damping_ratio: float
    print_time_s: float


@dataclass(frozen=True, slots=True)
class WeightsChange:
    """Another carriage, mode or extruder: from PRINT_TIME_S on these steppers (by name) follow X Y Z E so."""

    line: int
    weights: Mapping[str, tuple[float, float, float, float]]
    print_time_s: float


@dataclass(frozen=True, slots=True)
class SmoothTimeChange:
    """SET_PRESSURE_ADVANCE: from PRINT_TIME_S on the advance of EXTRUDER is spread over SMOOTH_S."""

    line: int
    extruder: str
    smooth_s: float
    print_time_s: float


@dataclass(frozen=True, slots=True)
class SurfaceChange:
    """From PRINT_TIME_S on Z follows the shape SURFACE (None: a plane); a PositionSet follows."""

    line: int
    surface: Surface | None
    print_time_s: float


AS_SOON_AS_POSSIBLE = -1


@dataclass(frozen=True, slots=True)
class Timed:
    """Something that takes effect at its place among the moves, without stopping them."""

    line: int
    after_moves: int
    """It does so behind the planner's first so many moves, or AS_SOON_AS_POSSIBLE."""
    act: Callable[[float], None]
    """On the control loop, with the print time; 0: as soon as possible."""


@dataclass(eq=False, slots=True)
class StandstillAction:
    """Something that is done while the machine stands, from PRINT_TIME_S on; the program waits for it.

    A driver that performs it fills in what came of it; one that only plans leaves ``done`` as it is.
    """

    line: int
    print_time_s: float
    perform: Callable[[], Awaitable[Done | None]]
    done: Done | None
    over: bool = False
    """Whether it was performed, to whatever end."""
    failure: str = ""
    """Why it could not be done, a sentence."""
    moved: bool = False
    """Whether steppers may have been moved past the program's moves."""
    cancelled: bool = False
    """Set to cancel it; the driver then ends it."""


@dataclass(frozen=True, slots=True)
class Reply:
    """An answer that the program asked for (M114)."""

    line: int
    text: str
    kind: ReplyKind = ReplyKind.INFORMATION

    def __post_init__(self) -> None:
        """Replace what a terminal would obey: programs and macros may put anything into it."""
        object.__setattr__(self, "text", printable_lines(self.text))


@dataclass(frozen=True, slots=True)
class Notice:
    """Something the user should know; each is reported once per job."""

    line: int
    text: str

    def __post_init__(self) -> None:
        """Replace what a terminal would obey."""
        object.__setattr__(self, "text", printable_lines(self.text))


@dataclass(frozen=True, slots=True)
class Emergency:
    """M112."""

    line: int


@dataclass(frozen=True, slots=True)
class End:
    """The program has ended; the machine comes to a standstill at PRINT_TIME_S."""

    lines: int
    print_time_s: float


MachineChange = ShaperChange | WeightsChange | SmoothTimeChange | SurfaceChange
"""Changes of what step generation does with the same moves."""
Event = (
    Progress
    | Idle
    | Full
    | Wait
    | PositionSet
    | MachineChange
    | Timed
    | StandstillAction
    | Reply
    | Notice
    | Emergency
    | End
)

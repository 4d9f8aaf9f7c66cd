"""What a ``Job`` tells whoever drives it. Lines count from 1; print times are seconds (docs/architecture.md).

==============  ==========================================================================================
event           what the driver does before it calls ``step`` again
==============  ==========================================================================================
Progress        nothing
Idle            waits for input; plans what there is to a standstill before the machine runs dry
Full            takes and releases trapezoids (a streamer: waits until there is room, or raises plan_until_s)
Wait            takes all trapezoids; in real time, waits until PRINT_TIME_S has been executed
PositionSet     takes all trapezoids, then tells step generation where the machine stands
Reply, Notice   shows the text
Emergency       stops the machine at once; the job is over
End             takes all trapezoids; the job is over
==============  ==========================================================================================
"""

from nodes.records import record


@record
class Progress:
    """A piece of the program was read."""

    line: int
    done_bytes: int
    size_bytes: int | None
    """None where the length is not known."""


@record
class Idle:
    """The program's source has nothing at present, but has not ended: someone is typing."""


@record
class Full:
    """The planner has no room for the next line."""


@record
class Wait:
    """M400: all moves are planned to a standstill that is reached at PRINT_TIME_S."""

    line: int
    print_time_s: float


@record
class PositionSet:
    """G28: from PRINT_TIME_S the machine stands at POSITION (X Y Z E, mm); AXES (letters) were set.

    All earlier trapezoids end in the old position, all later ones begin in the new one.
    """

    line: int
    axes: str
    position: tuple[float, float, float, float]
    print_time_s: float


@record
class Reply:
    """An answer that the program asked for (M114)."""

    line: int
    text: str


@record
class Notice:
    """Something the user should know; each is told once per job."""

    line: int
    text: str


@record
class Emergency:
    """M112."""

    line: int


@record
class End:
    """The program has ended; the machine comes to a standstill at PRINT_TIME_S."""

    lines: int
    print_time_s: float


Event = Progress | Idle | Full | Wait | PositionSet | Reply | Notice | Emergency | End

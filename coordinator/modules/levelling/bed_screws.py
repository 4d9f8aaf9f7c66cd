"""[bed_screws]: brings the nozzle above one screw after the other, which are adjusted by hand.

ACCEPT: this screw needs no further change. ADJUSTED: it was changed significantly, so another round of all
screws follows. ABORT ends it.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

from coordinator.config.options import FloatOption, Option, SectionSpec
from coordinator.config.sections.bounds import MAX_POSITION, MAX_SPEED
from coordinator.gcode.builtins.state import go
from coordinator.gcode.commands import (
    Call,
    Immediate,
    Phases,
    ProgramAction,
    ProgramContext,
    Reading,
)
from coordinator.gcode.parser import WordError
from coordinator.modules.base import Build, Module
from coordinator.modules.levelling.points import HEIGHT, TRAVEL_SPEED
from coordinator.modules.levelling.screws import SCREW, Screw, read_screws
from coordinator.modules.levelling.surfaces import Place
from coordinator.modules.probes.manual_probe import ManualProbe
from coordinator.support.values import Value

PROBE_HEIGHT: Final = FloatOption(
    name="probe_height",
    help="height of the nozzle above a screw, so that the bed may expand when it gets hot",
    default=0.0,
    unit="mm",
    minimum=-MAX_POSITION,
    maximum=MAX_POSITION,
)
PROBE_SPEED: Final = FloatOption(
    name="probe_speed", help="speed of the way down", default=5.0, unit="mm/s", above=0, maximum=MAX_SPEED
)
_OPTIONS: Final[tuple[Option[Any], ...]] = (TRAVEL_SPEED, HEIGHT, PROBE_HEIGHT, PROBE_SPEED)


class BedScrews(Module):
    """The section."""

    SPEC = SectionSpec("Moves to each screw of the bed while it is adjusted by hand", _OPTIONS, family=SCREW)

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._screws = read_screws(build, own=(), fine=True)
        self._speed, self._height = build.get(TRAVEL_SPEED), build.get(HEIGHT)
        self._low, self._down_speed = build.get(PROBE_HEIGHT), build.get(PROBE_SPEED)
        self._round: str = ""
        """``adjust``, then ``fine``; empty: nothing is going on."""
        self._at = self._accepted = 0
        build.shared(ManualProbe).others.append(self)
        reads: tuple[tuple[str, str, Callable[[Call], Reading]], ...] = (
            ("BED_SCREWS_ADJUST", "Move to each bed screw in turn, to adjust it by hand", self._read_begin),
            (
                "ADJUSTED",
                "The current bed screw was changed significantly: repeat all screws",
                self._read_adjusted,
            ),
        )
        for name, text, read in reads:
            build.add_command(name, text, read)

    def status(self) -> Mapping[str, Value]:
        """Report which screw it is at."""
        active = self.is_active
        return {
            "is_active": active,
            "state": self._round or None,
            "current_screw": self._at if active else None,
            "accepted_screws": self._accepted if active else None,
        }

    @property
    def is_active(self) -> bool:
        """Whether it waits for an answer."""
        return bool(self._round)

    # -------------------------------------------------------------------------------------------- commands

    def _read_begin(self, call: Call) -> Reading:
        call.parameters()
        if missing := next((letter for letter in "XYZ" if letter not in call.homed), ""):
            raise WordError(f"{call.command.name} comes before {missing} is homed; home with G28 first")
        if self.is_active:
            raise WordError(f"{call.command.name}: already in progress; use ACCEPT, ADJUSTED or ABORT first")
        return Phases(lambda job: self._enter(job, "adjust"))

    def read_accept(self, call: Call) -> Reading:
        """Go to the next screw, or to the next round, or end."""
        del call
        return Phases(lambda job: self._next(job, self._accepted + 1))

    def _read_adjusted(self, call: Call) -> Reading:
        call.parameters()
        if not self.is_active:
            raise WordError(f"{call.command.name} is for BED_SCREWS_ADJUST; begin with that")
        return Phases(lambda job: self._next(job, 0))

    def read_abort(self, call: Call) -> Reading:
        """End it."""
        del call

        def end(job: ProgramContext) -> Iterator[Reading]:
            self._round = ""
            yield from self._lift(job)
            yield Immediate(("adjusting the bed screws was aborted",))

        return Phases(end)

    # ---------------------------------------------------------------------------------------------- rounds

    def _places(self) -> Sequence[tuple[Screw, Place]]:
        if self._round == "adjust":
            return [(screw, screw.place) for screw in self._screws]
        return [(screw, screw.fine) for screw in self._screws if screw.fine is not None]

    def _enter(self, job: ProgramContext, round_: str) -> Iterator[Reading]:
        self._round, self._at, self._accepted = round_, 0, 0
        if self._places():
            yield from self._go(job)
            return
        self._round = ""
        yield from self._lift(job)
        yield Immediate(("all bed screws are adjusted",))

    def _next(self, job: ProgramContext, accepted: int) -> Iterator[Reading]:
        self._accepted = accepted
        if accepted < len(self._places()):
            self._at = (self._at + 1) % len(self._places())
            yield from self._go(job)
        elif self._round == "adjust":
            yield from self._enter(job, "fine")
        else:
            self._round = ""
            yield from self._lift(job)
            yield Immediate(("all bed screws are adjusted",))

    def _go(self, job: ProgramContext) -> Iterator[Reading]:
        screw, (x, y) = self._places()[self._at]
        yield from self._lift(job)
        e = job.planner.toolhead_position[3]
        yield ProgramAction(lambda job: go(job, [x, y, self._height, e], self._speed))
        yield ProgramAction(lambda job: go(job, [x, y, self._low, e], self._down_speed))
        yield Immediate(
            (f"adjust {screw.name}; then ACCEPT, or ADJUSTED after a significant change, or ABORT",)
        )

    def _lift(self, job: ProgramContext) -> Iterator[Reading]:
        x, y, _, e = job.planner.toolhead_position
        yield ProgramAction(lambda job: go(job, [x, y, self._height, e], self._speed))

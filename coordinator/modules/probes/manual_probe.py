"""Finding a height by hand: MANUAL_PROBE, Z_ENDSTOP_CALIBRATE; TESTZ moves, ACCEPT and ABORT end it.

TESTZ also halves: between the height at hand and the next one that was tried above (``+``) or below (``-``).
"""

from bisect import insort
from collections.abc import Callable, Iterator
from typing import Final, Protocol

from coordinator.config.model import RailDescription
from coordinator.gcode.builtins.state import go
from coordinator.gcode.commands import AtStandstill, Call, Phases, ProgramAction, ProgramContext, Reading
from coordinator.gcode.events import Done, Reply
from coordinator.gcode.parser import Command, WordError, number, quoted
from coordinator.kinematics.base import Point
from coordinator.modules.base import Build, Module
from coordinator.support.values import Value
from nodes.support.errors import CanductorError

SPEED: Final = 5.0
"""mm/s of TESTZ, unless the beginning says otherwise."""
HALVED_MM: Final = 0.5
"""``+`` and ``-`` where nothing was tried yet on that side, halved."""
SAME_MM: Final = 1e-6
Then = Callable[[ProgramContext, Point], Iterator[Reading]]
"""What follows when the nozzle is at the place that was found: where the motors have it, mm."""
_BEGUN: Final = "now move with TESTZ Z=-0.1 (+, -, ++, --) until it fits; end with ACCEPT or ABORT"


class TakesAnswers(Protocol):
    """Another dialogue that ACCEPT and ABORT answer while it is active."""

    @property
    def is_active(self) -> bool:
        """Whether it waits for an answer."""

    def read_accept(self, call: Call) -> Reading:
        """Return what ACCEPT does."""

    def read_abort(self, call: Call) -> Reading:
        """Return what ABORT does."""


class ManualProbe(Module):
    """The commands; one search at a time."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.name = "manual_probe"
        self._machine = build.machine
        self._accepted: Callable[[float], tuple[str, ...]] | None = None
        """What a height that is accepted leads to; None: nothing is looked for."""
        self._then: Then | None = None
        """What follows a height that is accepted, where others are looked for after it."""
        self._asked_by: TakesAnswers | None = None
        """The dialogue that the search is part of, and which ends with it."""
        self.others: list[TakesAnswers] = []
        """Other dialogues, such as that for the turns of screws."""
        self._speed = SPEED
        self._tried: list[float] = []
        self._z = 0.0
        """Where the nozzle is while a height is looked for."""
        for name, text, read in (
            ("MANUAL_PROBE", "Begin to look for a height by hand; SPEED in mm/s", self._read_probe),
            ("Z_ENDSTOP_CALIBRATE", "Find position_endstop of stepper_z by hand", self._read_calibrate),
            (
                "TESTZ",
                "Move by Z mm on the way to a height; + - ++ -- halve and go back",
                self._read_move,
            ),
            ("ACCEPT", "Take the height that was found by hand", self._read_accept),
            ("ABORT", "End the search for a height without a result", self._read_abort),
            (
                "Z_OFFSET_APPLY_ENDSTOP",
                "Make the offset of Z part of position_endstop",
                self._read_apply,
            ),
        ):
            build.add_command(name, text, read)

    def status(self) -> dict[str, Value]:
        """Return whether a height is looked for, and between which of those that were tried."""
        active, z = self._accepted is not None, self._z
        below, above = self._beside(z) if active else (None, None)
        return {
            "is_active": active,
            "z_position": z if active else None,
            "z_position_lower": below,
            "z_position_upper": above,
        }

    # ----------------------------------------------------------------------------------------------- begin

    def _read_probe(self, call: Call) -> Reading:
        return self._begin_at_speed(call, lambda z: (f"Z position is {z:.3f}",))

    def _read_calibrate(self, call: Call) -> Reading:
        rail, endstop = self._endstop(call)
        return self._begin_at_speed(call, lambda z: self._keep(rail, endstop - z))

    def _read_apply(self, call: Call) -> Reading:
        call.parameters()
        rail, endstop = self._endstop(call)
        offset = call.figures()["gcode_move"]["homing_origin"].z  # type: ignore[attr-defined]

        async def apply() -> Done:
            return Done(self._keep(rail, endstop - offset) if offset else ("the offset of Z is 0",))

        return AtStandstill(apply)

    def _endstop(self, call: Call) -> tuple[RailDescription, float]:
        """Return the rail of stepper_z and its position_endstop; raises WordError where there is none."""
        for rail in self._machine.rails:
            if rail.axis == "z" and rail.steppers[0].name == "stepper_z":
                found = rail.homing.position_endstop
                if found is not None:
                    return rail, found
        raise WordError(f"{call.command.name} needs a position_endstop of [stepper_z]; this machine has none")

    def _begin_at_speed(self, call: Call, accepted: Callable[[float], tuple[str, ...]]) -> Reading:
        values = call.parameters("SPEED")
        speed = number(call.command.name, values, "SPEED") if "SPEED" in values else SPEED
        if not 0 < speed <= self._machine.limits.max_z_velocity:
            raise WordError(
                f"SPEED of {call.command.name} is {speed:g}; it must be above 0 and at most"
                f" {self._machine.limits.max_z_velocity:g} mm/s"
            )
        return self.begin(call, accepted, speed)

    def check_free(self, call: Call, asked_by: TakesAnswers | None = None) -> None:
        """Raise WordError where no height can be looked for, as part of the dialogue ASKED_BY."""
        if "Z" not in call.homed:
            raise WordError(f"{call.command.name} comes before Z is homed; home with G28 first")
        self.check_no_dialogue(call, asked_by)

    @property
    def is_searching(self) -> bool:
        """Whether a height is looked for."""
        return self._accepted is not None

    def check_no_dialogue(self, call: Call, asked_by: TakesAnswers | None = None) -> None:
        """Raise WordError where ACCEPT and ABORT have a meaning already, but for the dialogue ASKED_BY."""
        if self.is_searching or self._other not in (None, asked_by):
            raise WordError(f"{call.command.name}: a height is looked for already; ACCEPT or ABORT that")

    @property
    def _other(self) -> TakesAnswers | None:
        """The other dialogue that is going on."""
        return next((other for other in self.others if other.is_active), None)

    def begin(
        self, call: Call, accepted: Callable[[float], tuple[str, ...]], speed: float = SPEED
    ) -> Reading:
        """Return what begins to look for a height, of which ACCEPTED makes replies.

        TESTZ goes at SPEED, mm/s. Raises WordError.
        """
        return self._begin(call, accepted, None, speed)

    def follow(
        self, call: Call, then: Then, speed: float = SPEED, *, asked_by: TakesAnswers | None = None
    ) -> Reading:
        """Return what begins to look for a height, which THEN goes on from; raises WordError.

        TESTZ goes at SPEED, mm/s. ASKED_BY: the dialogue that it is part of.
        """
        return self._begin(call, lambda _: (), then, speed, asked_by)

    def _begin(
        self,
        call: Call,
        accepted: Callable[[float], tuple[str, ...]],
        then: Then | None,
        speed: float,
        asked_by: TakesAnswers | None = None,
    ) -> Reading:
        self.check_free(call, asked_by)

        def act(job: ProgramContext) -> bool:
            self._accepted, self._then, self._speed, self._tried = accepted, then, speed, []
            self._asked_by = asked_by
            job.emit(Reply(job.line, _BEGUN))
            self._tell(job)
            return True

        return ProgramAction(act)

    # ------------------------------------------------------------------------------------------------ search

    def _read_move(self, call: Call) -> Reading:
        self._check_active(call)
        word = call.parameters("Z").get("Z")
        if word is None:
            raise WordError("TESTZ has no Z; add Z=-0.1 or Z=+, -, ++, --")

        def act(job: ProgramContext) -> bool:
            x, y, z, e = job.planner.toolhead_position
            target = self._target(call.command, word, z)
            if not go(job, [x, y, target, e], self._speed):
                return False
            if z not in self._tried:
                insort(self._tried, z)
            self._tell(job)
            return True

        return ProgramAction(act)

    def _target(self, command: Command, word: str, z: float) -> float:
        below, above = self._beside(z)
        match word:
            case "+":
                return (z + above) / 2 if above is not None else z + HALVED_MM / 2
            case "-":
                return (z + below) / 2 if below is not None else z - HALVED_MM / 2
            case "++" | "--":
                found = above if word == "++" else below
                if found is None:
                    raise WordError(f"TESTZ Z={word}: none was tried {'above' if word == '++' else 'below'}")
                return found
        return z + number(command.name, {"Z": word}, "Z")

    def _beside(self, z: float) -> tuple[float | None, float | None]:
        """Return the nearest heights that were tried, below and above Z."""
        below = [tried for tried in self._tried if tried < z - SAME_MM]
        above = [tried for tried in self._tried if tried > z + SAME_MM]
        return (below[-1] if below else None), (above[0] if above else None)

    def _tell(self, job: ProgramContext) -> None:
        z = self._z = job.planner.toolhead_position[2]
        below, above = ("?" if tried is None else f"{tried:.3f}" for tried in self._beside(z))
        job.emit(Reply(job.line, f"Z position: {below} --> {z:.3f} <-- {above}"))

    # -------------------------------------------------------------------------------------------------- end

    def _read_accept(self, call: Call) -> Reading:
        call.parameters()
        if (other := self._other) is not None:
            return other.read_accept(call)
        accepted = self._check_active(call)
        if (then := self._then) is not None:
            return Phases(lambda job: self._go_on(job, then))

        async def accept() -> Done:
            self._accepted = None
            return Done(accepted(call.position[2]))

        return AtStandstill(accept)

    def _go_on(self, job: ProgramContext, then: Then) -> Iterator[Reading]:
        x, y, z, _ = job.machine.motor_position(job.planner.toolhead_position)
        self._accepted = self._then = None
        yield from then(job, (x, y, z))

    def _read_abort(self, call: Call) -> Reading:
        call.parameters()
        if (other := self._other) is not None:
            return other.read_abort(call)
        self._check_active(call)

        async def abort() -> Done:
            self._accepted = self._then = None
            return Done((f"nothing is kept; Z stays at {call.position[2]:.3f}",))

        def run(_: ProgramContext) -> Iterator[Reading]:
            asked_by = self._asked_by
            yield AtStandstill(abort)
            if asked_by is not None:
                yield asked_by.read_abort(call)

        return Phases(run)

    def _check_active(self, call: Call) -> Callable[[float], tuple[str, ...]]:
        if self._accepted is None:
            raise WordError(
                f"{call.command.name} is for looking for a height; begin with {quoted('MANUAL_PROBE')} or"
                f" {quoted('Z_ENDSTOP_CALIBRATE')}"
            )
        return self._accepted

    def _keep(self, rail: RailDescription, endstop: float) -> tuple[str, ...]:
        """Save ENDSTOP, mm, as position_endstop of RAIL; raises CanductorError for one outside its range."""
        low, high = rail.position_min, rail.position_max
        if (low is not None and endstop < low) or (high is not None and endstop > high):
            way_out = "raise position_max" if high is not None and endstop > high else "lower position_min"
            raise CanductorError(
                f"position_endstop of [stepper_z] would be {endstop:.3f}, outside position_min and"
                f" position_max ({low:g} to {high:g} mm), so it was not kept; {way_out} in the configuration,"
                " then RESTART and calibrate again"
            )
        self.live.save("stepper_z", "position_endstop", f"{endstop:.3f}")
        return (f"stepper_z: position_endstop: {endstop:.3f}; SAVE_CONFIG writes it and restarts",)

"""[skew_correction]: axes that do not stand at right angles to each other.

What a program calls X Y Z is made by axes that lean: X = x + xy·y + xz·z, Y = y + yz·z for steppers that
are driven to x, y, z. Steppers follow the inverse: the correction changes the weights of each of them.
"""

import math
from collections.abc import Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final

from coordinator.config.errors import ConfigError
from coordinator.config.options import FloatOption, SectionSpec
from coordinator.gcode.builtins.machine import come_to_standstill
from coordinator.gcode.commands import (
    AtStandstill,
    Call,
    Immediate,
    Phases,
    Position,
    ProgramAction,
    ProgramContext,
    Reading,
)
from coordinator.gcode.events import Done, PositionSet, WeightsChange
from coordinator.gcode.parameters import bounded, flag, one, value
from coordinator.gcode.parser import Command, WordError, command_line, quoted
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.compensation.reach import beyond_range
from coordinator.modules.homing.homing import Homing
from coordinator.runtime.module_context import ModuleContext
from coordinator.support.values import Value

SKEW_MAX: Final = 0.2
"""Of any plane: some 11 degrees. More is a mistake of who measured."""
PROFILES_MAX: Final = 50
"""That a program may make; clients get all that wait for SAVE_CONFIG."""
RESTORE: Final = "_SET_SKEW"
_PLANES: Final = ("XY", "XZ", "YZ")


def _option(plane: str) -> FloatOption:
    first, second = plane[0], plane[1]
    return FloatOption(
        name=f"{plane.lower()}_skew",
        help=f"How far {first} goes with each mm of {second}, of a profile; SKEW_PROFILE SAVE finds it",
        default=0.0,
        minimum=-SKEW_MAX,
        maximum=SKEW_MAX,
    )


OPTIONS: Final = {plane: _option(plane) for plane in _PLANES}


@dataclass(frozen=True, slots=True)
class Skew:
    """How axes lean: mm of the first axis of a plane with each mm of the second."""

    xy: float = 0.0
    xz: float = 0.0
    yz: float = 0.0

    def made(self, at: Position) -> Position:
        """Return where the head is when steppers are driven to AT."""
        x, y, z, e = at
        return (x + self.xy * y + self.xz * z, y + self.yz * z, z, e)

    def wanted(self, at: Position) -> Position:
        """Return where steppers have to be driven to for the head to be AT."""
        x, y, z, e = at
        y -= self.yz * z
        return (x - self.xy * y - self.xz * z, y, z, e)

    def weights(self, straight: Position) -> Position:
        """Return what a stepper follows that followed STRAIGHT axes."""
        x, y, z, e = straight
        return (x, y - x * self.xy, z - y * self.yz - x * (self.xz - self.xy * self.yz), e)


class SkewCorrection(Module):
    """A profile; the plain section has none."""

    SPEC = SectionSpec(
        "Axes that are not at right angles; [skew_correction NAME] is a profile", tuple(OPTIONS.values())
    )
    NAMED = True
    NAMELESS = True

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.profile = build.reader.section.instance
        self.skew = Skew(**{plane.lower(): build.get(option) for plane, option in OPTIONS.items()})
        motors = build.machine.motors
        if build.machine.dual_carriage is not None or not all(motor.function.linear for motor in motors):
            raise ConfigError(
                build.place,
                f"[{build.name}] needs a machine whose motors move along X, Y and Z or sums of them, with one"
                " carriage; remove it",
            )
        build.shared(Skews).straight = {motor.name: motor.weights for motor in motors}


class Skews(Module):
    """The commands, and the skew in effect."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.name = "skew_correction"
        self.straight: Mapping[str, Position] = {}
        """What each motor follows without any correction."""
        self.now = Skew()
        """The skew that is corrected for the lines to come."""
        self._profile = ""
        self._profiles: dict[str, Skew] = {}
        build.shared(Homing).corrected = self.home
        for name, help_, read in (
            ("SET_SKEW", "Correct what was measured: XY=AC,BD,AD XZ= YZ=, or CLEAR=1", self._set),
            ("GET_CURRENT_SKEW", "Report the skew that is corrected", self._report),
            ("CALC_MEASURED_SKEW", "Report the skew that the lengths AC BD AD mean", self._calculate),
            ("SKEW_PROFILE", "LOAD, SAVE or REMOVE a profile by its name", self._manage),
            (RESTORE, "Restore the skew that was corrected before a crash", self._restore),
        ):
            build.add_command(name, help_, read)

    def link(self, modules: Modules) -> None:
        """Find the profiles."""
        self._profiles = {found.profile: found.skew for found in modules.of(SkewCorrection) if found.profile}

    def status(self) -> Mapping[str, Value]:
        """Report the profile that was loaded last, and what holds."""
        factors = {f"{plane.lower()}_skew": getattr(self.now, plane.lower()) for plane in _PLANES}
        return {"current_profile_name": self._profile, **factors}

    def take(self, job: ProgramContext, skew: Skew, profile: str = "") -> bool:
        """Correct SKEW from here on; the head stays. False: the planner has to be emptied first.

        Raises WordError for one that drives motors too far beyond their range.
        """
        planner = job.planner
        if wrong := beyond_range(planner.limits, lambda at: skew.wanted((*at, 0.0))[:3]):
            raise WordError(
                f"the skew is refused: {wrong}; measure both diagonals and the side of the print again"
            )
        if not come_to_standstill(job):
            return False
        position = skew.made(self.now.wanted(planner.toolhead_position))
        planner.set_position(position)
        self.now, self._profile = skew, profile
        at_s = planner.print_time_end_s
        job.emit(PositionSet(job.line, "", position, at_s))
        follows = {name: skew.weights(straight) for name, straight in self.straight.items()}
        job.machine.follows = follows
        job.emit(WeightsChange(job.line, follows, at_s))
        return True

    def home(self, read: Callable[[Call, str], Reading]) -> Callable[[Call, str], Reading]:
        """Return what reads G28 as READ does, and converts the positions of endstops to those of programs."""

        def homing(call: Call, axes: str) -> Reading:
            reading = read(call, axes)
            if isinstance(reading, Phases):
                return Phases(lambda job: self._corrected_phases(reading, job, call.command))
            if isinstance(reading, AtStandstill):
                return AtStandstill(self._corrected(reading.perform, call))
            return reading

        return homing

    def _corrected_phases(self, phases: Phases, job: ProgramContext, command: Command) -> Iterator[Reading]:
        for reading in phases.run(job):
            if isinstance(reading, AtStandstill):
                call = job.call(command)
                yield AtStandstill(self._corrected(reading.perform, call), reading.planned)
            else:
                yield reading

    def _corrected(
        self, perform: Callable[[], Awaitable[Done | None]], call: Call
    ) -> Callable[[], Awaitable[Done | None]]:
        async def corrected() -> Done | None:
            done = await perform()
            if done is None or done.position is None:
                return done
            before = self.now.wanted(call.position)
            # An axis that is not homed may have been moved, as [safe_z_home] does for Z.
            driven = [
                new if letter in done.homed else old + (new - at)
                for letter, old, at, new in zip("XYZE", before, call.position, done.position, strict=True)
            ]
            x, y, z, _ = self.now.made((driven[0], driven[1], driven[2], 0.0))
            return replace(done, position=(x, y, z, done.position[3]))

        return corrected

    @property
    def restoring(self) -> str:
        """The line that restores the skew in effect; empty: nothing is corrected."""
        if self.now == Skew():
            return ""
        return command_line(RESTORE, **{plane: getattr(self.now, plane.lower()) for plane in _PLANES})

    # ------------------------------------------------------------------------------------------ commands

    def _restore(self, call: Call) -> Reading:
        given = call.parameters(*_PLANES)
        skew = Skew(
            **{
                plane.lower(): bounded(call.command, given, plane, 0.0, low=-SKEW_MAX, high=SKEW_MAX)
                for plane in _PLANES
            }
        )
        return ProgramAction(lambda job: self.take(job, skew))

    def _set(self, call: Call) -> Reading:
        given = call.parameters(*_PLANES, "CLEAR")
        if flag(call.command, given, "CLEAR"):
            return ProgramAction(lambda job: self.take(job, Skew()))
        measured = {
            plane: measured_skew(call.command, plane, text)
            for plane, text in given.items()
            if plane in _PLANES
        }
        if not measured:
            raise WordError("SET_SKEW has nothing to set; give XY=AC,BD,AD as measured, or CLEAR=1")

        def act(job: ProgramContext) -> bool:
            return self.take(job, replace(self.now, **{plane.lower(): t for plane, t in measured.items()}))

        return ProgramAction(act)

    def _report(self, call: Call) -> Reading:
        call.parameters()
        return Immediate(tuple(f"{plane}: {_shown(getattr(self.now, plane.lower()))}" for plane in _PLANES))

    def _calculate(self, call: Call) -> Reading:
        given = call.parameters("AC", "BD", "AD")
        ac, bd, ad = (value(call.command, given, name) for name in ("AC", "BD", "AD"))
        return Immediate((f"Calculated skew: {_shown(skew_of(call.command, ac, bd, ad))}",))

    def _manage(self, call: Call) -> Reading:
        given = call.parameters("LOAD", "SAVE", "REMOVE")
        if len(given) != 1:
            raise WordError("SKEW_PROFILE takes one of LOAD=name, SAVE=name and REMOVE=name")
        if "LOAD" in given:
            name = one(call.command, given, "LOAD", self._profiles)
            return ProgramAction(lambda job: self.take(job, self._profiles[name], name))
        if "REMOVE" in given:
            name = one(call.command, given, "REMOVE", self._profiles)
            return Immediate(act=lambda: self._remove(name))
        name = given["SAVE"]
        if not name.isidentifier():
            raise WordError(
                f"SKEW_PROFILE: {quoted(name)} cannot be a profile's name; take letters, digits and _"
            )
        if name not in self._profiles and len(self._profiles) >= PROFILES_MAX:
            raise WordError(f"SKEW_PROFILE: there are {PROFILES_MAX} profiles already; remove one of them")
        return Immediate((f"skew profile {name} is saved; SAVE_CONFIG writes it",), lambda: self._save(name))

    def _remove(self, name: str) -> None:
        self._profiles = {other: skew for other, skew in self._profiles.items() if other != name}
        if (live := self._live) is not None:
            live.soon_on_loop(lambda: _drop(live, name))

    def _save(self, name: str) -> None:
        skew = self._profiles[name] = self.now
        if (live := self._live) is not None:
            live.soon_on_loop(lambda: _keep(live, name, skew))


def _drop(live: "ModuleContext", name: str) -> None:
    if live.drop_saved(f"skew_correction {name}"):
        live.say(f"skew profile {name} is removed; SAVE_CONFIG removes it from the file")


def _keep(live: "ModuleContext", name: str, skew: Skew) -> None:
    for plane, option in OPTIONS.items():
        live.save(f"skew_correction {name}", option.name, f"{getattr(skew, plane.lower()):.6f}")


def measured_skew(command: Command, plane: str, text: str) -> float:
    """Return what ``AC,BD,AD`` of a PLANE means; raises WordError."""
    parts = text.split(",")
    if len(parts) != 3:
        raise WordError(f"{plane} of {command.name} is {quoted(text)}; give AC,BD,AD in mm, as measured")
    given = dict(zip(("AC", "BD", "AD"), parts, strict=True))
    ac, bd, ad = (value(command, given, name) for name in ("AC", "BD", "AD"))
    return skew_of(command, ac, bd, ad)


def skew_of(command: Command, ac: float, bd: float, ad: float) -> float:
    """Return how far a square leans whose diagonals are AC, BD and whose side is AD; raises WordError.

    AC² + BD² = 2 (AB² + AD²) gives the other side, and AC² - BD² = 4 AB AD sin δ the angle.
    """
    other = (ac * ac + bd * bd) / 2 - ad * ad
    sine = (ac * ac - bd * bd) / (4 * ad * math.sqrt(other)) if ad > 0 and other > 0 else math.inf
    tangent = sine / math.sqrt(1 - sine * sine) if abs(sine) < 1 else math.inf
    if not abs(tangent) <= SKEW_MAX:
        raise WordError(
            f"{command.name}: AC={ac:g} BD={bd:g} AD={ad:g} is no square that leans a little; measure both"
            " diagonals and a side again"
        )
    return tangent


def _shown(tangent: float) -> str:
    angle = math.atan(tangent)
    return f"{angle:.6f} radians, {math.degrees(angle):.2f} degrees"

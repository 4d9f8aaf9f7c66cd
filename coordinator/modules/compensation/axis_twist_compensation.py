"""[axis_twist_compensation]: corrects what a probe finds where a twisted axis leans it.

AXIS_TWIST_COMPENSATION_CALIBRATE measures places along an axis by the probe, and by hand with the nozzle.
What the probe errs there, but for the mean that belongs to z_offset, is taken off whatever it finds. It
counts where the probe is; between two places it is linear, beyond the outer ones as there.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from statistics import fmean
from typing import Any, ClassVar, Final

from coordinator.config.errors import ConfigError
from coordinator.config.options import BadValue, FloatOption, Option, SectionSpec
from coordinator.config.sections.bounds import MAX_POSITION
from coordinator.gcode.builtins.state import go
from coordinator.gcode.commands import Call, Immediate, Phases, ProgramAction, ProgramContext, Reading
from coordinator.gcode.parameters import bounded
from coordinator.gcode.parser import WordError, quoted
from coordinator.kinematics.base import Point
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.levelling.points import HEIGHT, TRAVEL_SPEED
from coordinator.modules.levelling.surfaces import Place
from coordinator.modules.probes.manual_probe import ManualProbe
from coordinator.modules.probes.probe import Measuring, Probe, lift

COUNT: Final = 3
MOST: Final = 100
LARGEST_MM: Final = 10.0
"""Of a compensation."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HeightsOption(Option[tuple[float, ...]]):
    """Several heights in mm, separated by commas."""

    def parse(self, text: str) -> tuple[float, ...]:
        """Return them."""
        number = FloatOption(name="", help="", minimum=-LARGEST_MM, maximum=LARGEST_MM)
        heights = tuple(number.parse(word.strip()) for word in text.split(",") if word.strip())
        if not 2 <= len(heights) <= MOST:
            raise BadValue
        return heights

    def rule(self) -> str:
        """Return what is allowed."""
        return f"2 to {MOST} heights in mm, at most {LARGEST_MM:g} mm, separated by commas"

    def stand_in(self) -> tuple[float, ...]:
        """Return any heights."""
        return (0.0, 0.0)


def _place(name: str, text: str) -> FloatOption:
    return FloatOption(name=name, help=text, unit="mm", minimum=-MAX_POSITION, maximum=MAX_POSITION)


@dataclass(frozen=True, slots=True)
class AxisOptions:
    """The options of one axis: where to calibrate along it, and what was found."""

    axis: str
    start: FloatOption
    end: FloatOption
    across: FloatOption
    heights: HeightsOption
    first: FloatOption
    last: FloatOption

    @property
    def all(self) -> tuple[Option[Any], ...]:
        """All of them."""
        return (self.start, self.end, self.across, self.heights, self.first, self.last)


def _axis_options(axis: str, other: str, heights: str) -> AxisOptions:
    return AxisOptions(
        axis,
        _place(
            f"calibrate_start_{axis}", f"{axis.upper()} of the nozzle at the first place of a calibration"
        ),
        _place(f"calibrate_end_{axis}", f"{axis.upper()} of the nozzle at its last place"),
        _place(f"calibrate_{other}", f"{other.upper()} of the nozzle at these places"),
        HeightsOption(
            name=heights, help=f"what is added to heights along {axis.upper()}; SAVE_CONFIG writes it"
        ),
        _place(f"compensation_start_{axis}", f"{axis.upper()} of the first of {heights}"),
        _place(f"compensation_end_{axis}", f"{axis.upper()} of the last one"),
    )


AXES: Final = {
    "X": _axis_options("x", "y", "z_compensations"),
    "Y": _axis_options("y", "x", "zy_compensations"),
}


@dataclass(frozen=True, slots=True)
class Compensation:
    """Heights at even distances along an axis, mm."""

    heights: tuple[float, ...]
    first: float
    last: float

    def at(self, place: float) -> float:
        """Return what to add at PLACE.

        >>> Compensation((0.0, 0.25, -0.125), 10.0, 30.0).at(15.0)
        0.125
        """
        where = (place - self.first) / (self.last - self.first) * (len(self.heights) - 1)
        if where <= 0:
            return self.heights[0]
        for number, (low, high) in enumerate(pairwise(self.heights)):
            if where <= number + 1:
                return low + (high - low) * (where - number)
        return self.heights[-1]


class AxisTwistCompensation(Module):
    """The compensation of both axes, and its command."""

    SPEC: ClassVar = SectionSpec(
        "Corrects heights that the probe finds along an axis that is twisted",
        (TRAVEL_SPEED, HEIGHT, *AXES["X"].all, *AXES["Y"].all),
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._place = build.place
        self._manual = build.shared(ManualProbe)
        self._speed, self._height = build.get(TRAVEL_SPEED), build.get(HEIGHT)
        self._probe: Probe | None = None
        self._ways = {
            axis: tuple(build.find(option) for option in (options.start, options.end, options.across))
            for axis, options in AXES.items()
        }
        self.compensations: dict[str, Compensation] = {}
        for axis, options in AXES.items():
            heights = build.find(options.heights)
            first, last = build.find(options.first), build.find(options.last)
            if heights is None:
                continue
            if first is None or last is None or not first < last:
                raise build.reader.bad(
                    options.heights, f"which needs {options.first.name}, and a higher {options.last.name}"
                )
            self.compensations[axis] = Compensation(heights, first, last)
        build.add_command(
            "AXIS_TWIST_COMPENSATION_CALIBRATE",
            "Find by hand what the probe errs along AXIS (X or Y) at SAMPLE_COUNT places",
            self._read,
        )

    def link(self, modules: Modules) -> None:
        """Find the probe; raises ConfigError."""
        self._probe = next(modules.of(Probe), None)
        if self._probe is None:
            raise ConfigError(self._place, f"[{self.name}] needs a probe; add [probe], or remove it")
        self._probe.corrections.append(self.at)

    def at(self, x: float, y: float) -> float:
        """Return what to add to a height that the probe finds at X, Y (its own place), mm."""
        return sum(found.at(x if axis == "X" else y) for axis, found in self.compensations.items())

    # -------------------------------------------------------------------------------------------- command

    def _read(self, call: Call) -> Reading:
        assert self._probe is not None
        command, given = call.command, call.parameters("AXIS", "SAMPLE_COUNT", "AUTO")
        axis = given.get("AXIS", "X").upper()
        if axis not in AXES:
            raise WordError(f"AXIS of {command.name} is {quoted(given['AXIS'])}; X or Y is possible")
        if given.get("AUTO", "0").lower() not in ("0", "false"):
            raise WordError(f"{command.name} AUTO=1 is not supported; the nozzle is lowered by hand")
        count = round(bounded(command, given, "SAMPLE_COUNT", COUNT, low=2, high=MOST))
        start, end, across = self._ways[axis]
        options = AXES[axis]
        if start is None or end is None or across is None or not start < end:
            raise WordError(
                f"{command.name} of {axis} needs {options.start.name}, a higher {options.end.name} and"
                f" {options.across.name} of [{self.name}]"
            )
        how = self._probe.how(command)
        self._probe.check(call)
        self._manual.check_free(call)
        along = [start + (end - start) * number / (count - 1) for number in range(count)]
        places = [(at, across) if axis == "X" else (across, at) for at in along]
        search = _Search(self, self._probe, call, how, Course(axis, start, end, tuple(places)))
        return Phases(search.run)

    def travel(self, job: ProgramContext, place: Place, lift_speed: float) -> Iterator[Reading]:
        """Bring the nozzle above PLACE."""
        yield from lift(job, self._height, lift_speed)
        speed, (x, y) = self._speed, place
        yield ProgramAction(lambda job: go(job, [x, y, *job.planner.toolhead_position[2:]], speed))

    def look_for(self, job: ProgramContext, call: Call, search: "_Search") -> Reading:
        """Return what begins to look for the bed by hand, after which SEARCH goes on."""
        return self._manual.follow(job.call(call.command), search.accepted)

    def take(self, axis: str, found: Compensation) -> str:
        """Follow FOUND along AXIS from now on, and keep it for SAVE_CONFIG; return a sentence."""
        self.compensations[axis] = found
        options = AXES[axis]
        heights = ", ".join(f"{height:.6f}" for height in found.heights)
        if self._live is not None:  # else the program is only planned
            self._live.save(self.name, options.heights.name, heights)
            self._live.save(self.name, options.first.name, f"{found.first:g}")
            self._live.save(self.name, options.last.name, f"{found.last:g}")
        return f"{options.heights.name}: {heights}; SAVE_CONFIG writes them"


@dataclass(frozen=True, slots=True)
class Course:
    """Where a calibration goes."""

    axis: str
    start: float
    end: float
    places: tuple[Place, ...]
    """Of the nozzle."""


class _Search:
    """One calibration: the places of COURSE are measured by the probe, and by hand."""

    def __init__(
        self, module: AxisTwistCompensation, probe: Probe, call: Call, how: Measuring, course: Course
    ) -> None:
        self._module, self._probe, self._call, self._how = module, probe, call, how
        self._course, self._places = course, course.places
        self._probed = 0.0
        self._errors: list[float] = []

    def run(self, job: ProgramContext) -> Iterator[Reading]:
        """Measure the next place by the probe, and begin to look for the bed there by hand."""
        place = x, y = self._places[len(self._errors)]
        dx, dy, dz = self._probe.offset
        yield Immediate((f"{self._call.command.name}: place {len(self._errors) + 1} of {len(self._places)}",))
        yield from self._module.travel(job, (x - dx, y - dy), self._how.lift_speed)
        yield from self._probe.deploy(job, self._call.command)
        found = yield from self._probe.measure(job, self._call.command, self._how)
        yield from self._module.travel(job, (x - dx, y - dy), self._how.lift_speed)
        yield from self._probe.stow(job, self._call.command)
        if found is None:
            return
        self._probed = found.nozzle[2] - dz - self._module.at(x, y)
        yield from self._module.travel(job, place, self._how.lift_speed)
        yield self._module.look_for(job, self._call, self)

    def accepted(self, job: ProgramContext, at: Point) -> Iterator[Reading]:
        """Go on: the nozzle is at the bed AT a place."""
        self._errors.append(self._probed - at[2])
        yield from self._module.travel(job, at[:2], self._how.lift_speed)
        if len(self._errors) < len(self._places):
            yield from self.run(job)
            return
        mean = fmean(self._errors)
        course, heights = self._course, tuple(mean - error for error in self._errors)
        found = Compensation(heights, course.start, course.end)
        yield Immediate((self._module.take(course.axis, found),))

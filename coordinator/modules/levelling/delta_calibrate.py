"""[delta_calibrate]: finds which delta a machine really is, by heights of its bed and by what it printed.

DELTA_CALIBRATE measures seven places; DELTA_ANALYZE takes lengths of the calibration object: seven pillars,
one in the middle and six around it, next to tower A and then counterclockwise. Both save what was measured as
how many steps each carriage was below its endstop, so that it stays true when the figures change.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from coordinator.config.errors import ConfigError
from coordinator.config.file import RawOption
from coordinator.config.options import BadValue, FloatOption, Option, SectionSpec, TextOption, parse_decimal
from coordinator.config.sections.bounds import MAX_POSITION
from coordinator.gcode.commands import Call, Immediate, Phases, ProgramContext, Reading
from coordinator.gcode.parameters import bounded
from coordinator.gcode.parser import WordError, quoted
from coordinator.kinematics.delta import Delta
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.levelling.delta_fit import (
    Distance,
    Height,
    Ways,
    fit_delta,
    nozzle_at,
    ways_at,
    worst_height_mm,
)
from coordinator.modules.levelling.points import OPTIONS as POINT_OPTIONS
from coordinator.modules.levelling.points import ProbePoints, how_to_measure
from coordinator.modules.levelling.surfaces import Place
from coordinator.modules.probes.probe import Measured, Probe

RADIUS: Final = FloatOption(
    name="radius",
    help="how far from the middle the bed is measured",
    unit="mm",
    above=0,
    maximum=MAX_POSITION,
)
AROUND: Final = 6
"""Places around the middle, and pillars of the object."""
HEIGHTS: Final = tuple(
    TextOption(name=name, help=text, default="")
    for number in range(AROUND + 1)
    for name, text in (
        (f"height{number}", f"saved: Z of place {number}, mm"),
        (f"height{number}_pos", f"saved: steps of a, b, c below their endstops at place {number}"),
    )
)
DISTANCE: Final = TextOption(
    name="distance", help="saved: distanceN in mm, between distanceN_pos1 and distanceN_pos2 in such steps"
)
_DISTANCE: Final = re.compile(r"(\d{1,2})(_pos1|_pos2)?", re.ASCII)
_OPTIONS: Final[tuple[Option[Any], ...]] = (RADIUS, *POINT_OPTIONS, *HEIGHTS)
PILLARS_MM: Final = 65.0
"""Between neighbours of the object, and from the middle to each."""
PILLARS_DEG: Final = tuple(210.0 + 60.0 * number for number in range(AROUND))
"""A, across from C, B, across from A, C, across from B."""
SPOKES: Final = (0, 2, 1, 0, 2, 1)
"""Which of the widths of the middle pillar, of spokes A, B, C, lies towards each."""
LENGTHS: Final = {
    "CENTER_DISTS": AROUND,
    "CENTER_PILLAR_WIDTHS": 3,
    "OUTER_DISTS": AROUND,
    "OUTER_PILLAR_WIDTHS": AROUND,
}
"""Parameters of DELTA_ANALYZE, and how many values each has."""


@dataclass(frozen=True, slots=True)
class _Known:
    """What was measured."""

    heights: tuple[Height, ...] = ()
    distances: tuple[Distance, ...] = ()


class DeltaCalibrate(Module):
    """The section."""

    SPEC = SectionSpec("Finds endstops, tower angles, radius and rods of a delta", _OPTIONS, family=DISTANCE)

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        delta = build.machine.kinematics
        if not isinstance(delta, Delta):
            raise ConfigError(build.place, f"[{build.name}] is for a delta; remove it")
        self._delta, self._place = delta, build.place
        rails = {rail.axis: rail for rail in build.machine.rails}
        self._motors = tuple(rails[axis].steppers[0] for axis in delta.rails)
        radius = build.get(RADIUS)
        places: list[Place] = [(0.0, 0.0)]
        for degrees in PILLARS_DEG:
            angle = math.radians(degrees)
            places.append((radius * math.cos(angle), radius * math.sin(angle)))
        self._points = ProbePoints(build, places)
        self._probe: Probe | None = None
        self._known = _Known(tuple(self._read_heights(build)), tuple(self._read_distances(build)))
        self._lengths: dict[str, tuple[float, ...]] = {}
        self._scale = 1.0
        build.add_command(
            "DELTA_CALIBRATE", "Measure the bed at seven places and correct the delta", self._read_calibrate
        )
        build.add_command(
            "DELTA_ANALYZE",
            "Take lengths of a printed object; CALIBRATE=extended corrects",
            self._read_analyze,
        )

    def link(self, modules: Modules) -> None:
        """Find the probe, without which the bed is measured by hand; raises NotSupported."""
        self._probe = self._points.find_probe(modules)

    # ---------------------------------------------------------------------------------------------- saved

    def _read_heights(self, build: Build) -> Iterator[Height]:
        for z_option, ways_option in zip(HEIGHTS[::2], HEIGHTS[1::2], strict=True):
            if not build.get(z_option) or not build.get(ways_option):
                continue
            try:
                (z,) = _numbers(build.get(z_option), 1)
                yield Height(z, self._ways(_numbers(build.get(ways_option), 3)))
            except BadValue:
                raise build.reader.bad(ways_option, "must be three numbers of steps, with Z in mm") from None

    def _read_distances(self, build: Build) -> Iterator[Distance]:
        parts: dict[int, dict[str, RawOption]] = {}
        for rest, raw in build.reader.family().items():
            match = _DISTANCE.fullmatch(rest)
            if match is None:
                raise ConfigError(raw.place, f"[{build.name}] has no option '{raw.name}'; remove it")
            parts.setdefault(int(match[1]), {})[match[2] or ""] = raw
        for number, found in sorted(parts.items()):
            try:
                (length,) = _numbers(found[""].value, 1)
                first, second = (self._ways(_numbers(found[name].value, 3)) for name in ("_pos1", "_pos2"))
            except (KeyError, BadValue):
                raise ConfigError(
                    next(iter(found.values())).place,
                    f"[{build.name}] needs distance{number} in mm, and distance{number}_pos1 and"
                    f" distance{number}_pos2 of three numbers; remove what is left of them",
                ) from None
            yield Distance(length, first, second)

    def _ways(self, steps: Sequence[float]) -> Ways:
        a, b, c = (count * motor.step_distance for count, motor in zip(steps, self._motors, strict=True))
        return (a, b, c)

    def _in_steps(self, ways: Ways) -> str:
        counts = (way / motor.step_distance for way, motor in zip(ways, self._motors, strict=True))
        return ", ".join(f"{count:.3f}" for count in counts)

    # ------------------------------------------------------------------------------------------- measuring

    def _read_calibrate(self, call: Call) -> Reading:
        how = how_to_measure(call, self._probe)
        by = None if how is None or self._probe is None else (self._probe, how)
        self._points.check(call, None if by is None else by[0])

        def found(job: ProgramContext, measured: list[Measured]) -> Iterator[Reading]:
            del job
            heights = tuple(
                Height(one.nozzle[2] - one.bed[2], ways_at(self._delta, one.nozzle)) for one in measured
            )
            yield self._solve(call, _Known(heights, self._known.distances))

        def run(job: ProgramContext) -> Iterator[Reading]:
            if job.machine.surface is not None:
                raise WordError(
                    f"{call.command.name}: Z follows a mesh or a tilt; BED_MESH_CLEAR comes first, or"
                    " remove [bed_tilt]"
                )
            yield from self._points.collect(job, call, by, found)

        return Phases(run)

    def _read_analyze(self, call: Call) -> Reading:
        given = call.parameters(*LENGTHS, "SCALE", "CALIBRATE")
        lengths = dict(self._lengths)
        for name, count in LENGTHS.items():
            if name in given:
                try:
                    lengths[name] = _numbers(given[name], count)
                except BadValue:
                    raise WordError(
                        f"{name} of DELTA_ANALYZE is {quoted(given[name])}; give {count} lengths in mm with"
                        " commas between them"
                    ) from None
        scale = bounded(call.command, given, "SCALE", self._scale, low=0.1, high=100)
        if "CALIBRATE" not in given:
            missing = [name for name in LENGTHS if name not in lengths]
            left = f"still missing: {', '.join(missing)}" if missing else "CALIBRATE=extended is next"
            return Immediate((f"lengths are kept; {left}",), lambda: self._keep_lengths(lengths, scale))
        if given["CALIBRATE"].lower() != "extended":
            raise WordError(
                f"CALIBRATE of DELTA_ANALYZE is {quoted(given['CALIBRATE'])}; extended is possible"
            )
        if missing := [name for name in LENGTHS if name not in lengths]:
            raise WordError(f"DELTA_ANALYZE needs {', '.join(missing)} first")
        if not self._known.heights:
            raise WordError("DELTA_ANALYZE needs the heights of a DELTA_CALIBRATE first")
        known = _Known(self._known.heights, tuple(self._distances(lengths, scale)))
        return self._solve(call, known)

    def _keep_lengths(self, lengths: dict[str, tuple[float, ...]], scale: float) -> None:
        self._lengths, self._scale = lengths, scale

    def _distances(self, lengths: Mapping[str, Sequence[float]], scale: float) -> Iterator[Distance]:
        """Yield what LENGTHS say: between centers of pillars, a width less than from edge to edge."""
        around = []
        for degrees in PILLARS_DEG:
            angle, radius = math.radians(degrees), PILLARS_MM * scale
            around.append(ways_at(self._delta, (radius * math.cos(angle), radius * math.sin(angle), 0.0)))
        middle = ways_at(self._delta, (0.0, 0.0, 0.0))
        inner, outer = lengths["CENTER_PILLAR_WIDTHS"], lengths["OUTER_PILLAR_WIDTHS"]
        for number, length in enumerate(lengths["CENTER_DISTS"]):
            yield Distance(length - inner[SPOKES[number]], middle, around[number])
        for number, length in enumerate(lengths["OUTER_DISTS"]):
            yield Distance(length - outer[number], around[number], around[(number + 1) % AROUND])

    # --------------------------------------------------------------------------------------------- solving

    def _solve(self, call: Call, known: _Known) -> Reading:
        """Find the delta, report and save it."""
        try:
            delta = fit_delta(self._delta, known.heights, known.distances)
        except ValueError as error:
            raise WordError(f"{call.command.name} failed: {error}") from None
        before, after = (worst_height_mm(one, known.heights) for one in (self._delta, delta))
        replies = [
            f"the worst height is {before:.4f} mm off, and {after:.4f} with these figures:",
            f"delta_radius: {delta.radius:.6f}",
        ]
        for motor, tower in zip(self._motors, delta.towers, strict=True):
            replies.append(
                f"{motor.name}: position_endstop: {tower.endstop_height:.6f},"
                f" angle: {math.degrees(tower.angle):.6f}, arm_length: {tower.rod_length:.6f}"
            )
        if known.distances:
            worst = max(
                abs(math.dist(nozzle_at(delta, one.first), nozzle_at(delta, one.second)) - one.length)
                for one in known.distances
            )
            replies.append(f"the worst of {len(known.distances)} lengths is {worst:.4f} mm off then")
        replies.append("SAVE_CONFIG writes them and restarts")
        return Immediate(tuple(replies), lambda: self._keep(delta, known))

    def _keep(self, delta: Delta, known: _Known) -> None:
        self._known = known
        if (live := self._live) is None:
            return
        texts = self._texts(delta, known)

        def save() -> None:
            for (section, option), text in texts.items():
                live.save(section, option, text)

        live.soon_on_loop(save)

    def _texts(self, delta: Delta, known: _Known) -> Mapping[tuple[str, str], str]:
        """Return what is saved, by section and option."""
        found = {("printer", "delta_radius"): f"{delta.radius:.6f}"}
        for motor, tower in zip(self._motors, delta.towers, strict=True):
            found[motor.name, "position_endstop"] = f"{tower.endstop_height:.6f}"
            found[motor.name, "angle"] = f"{math.degrees(tower.angle):.6f}"
            found[motor.name, "arm_length"] = f"{tower.rod_length:.6f}"
        for number, height in enumerate(known.heights):
            found[self.name, f"height{number}"] = f"{height.z:.6f}"
            found[self.name, f"height{number}_pos"] = self._in_steps(height.ways)
        for number, one in enumerate(known.distances):
            found[self.name, f"distance{number}"] = f"{one.length:.6f}"
            found[self.name, f"distance{number}_pos1"] = self._in_steps(one.first)
            found[self.name, f"distance{number}_pos2"] = self._in_steps(one.second)
        return found


def _numbers(text: str, count: int) -> tuple[float, ...]:
    """Return COUNT numbers with commas between them; raises BadValue."""
    found = tuple(parse_decimal(word) for word in text.split(","))
    if len(found) != count:
        raise BadValue
    return found

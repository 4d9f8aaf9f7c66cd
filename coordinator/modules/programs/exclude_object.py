"""[exclude_object]: objects of a program that need not be printed to their end.

A slicer says where each object begins and ends. Moves of one that is excluded are followed but not made; the
filament then is where the next object expects it, neither further forward nor further back. Objects do not
stand within one another: the begin of one ends the one before.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Final

from coordinator.config.options import SectionSpec
from coordinator.gcode.commands import Call, Immediate, ProgramAction, ProgramContext, Reading
from coordinator.gcode.parameters import flag, needed
from coordinator.gcode.parser import Command, WordError, number, quoted
from coordinator.modules.base import Build, Module
from coordinator.motion.planner.planner import FeedStatus, Planner
from coordinator.support.quoting import nearest_or_all
from coordinator.support.values import Value

OBJECTS_MAX: Final = 1000
NAME_MAX: Final = 512
"""Characters; slicers make names of those of files."""
POINTS_MAX: Final = 1000
ALL_POINTS_MAX: Final = 10_000
"""Of all objects: clients get them whenever one is added. Slicers write 4 to some 30 for each."""
_SPEED_MM_S: Final = 30.0
"""At which filament is drawn back or pushed forward behind an excluded object."""


@dataclass(frozen=True)
class _Object:
    name: str
    center: tuple[float, float] | None = None
    polygon: tuple[tuple[float, float], ...] = ()

    @cached_property
    def shown(self) -> Value:
        """As the status has it; the same at each look."""
        return _status(self)

    def simplified(self) -> "_Object":
        """Return it with the rectangle around its polygon: enough for a mesh, and to see where it is."""
        xs, ys = zip(*self.polygon, strict=True)
        corners = ((min(xs), min(ys)), (max(xs), min(ys)), (max(xs), max(ys)), (min(xs), max(ys)))
        return _Object(self.name, self.center, corners)


class ExcludeObject(Module):
    """The objects of the program that is being read."""

    SPEC = SectionSpec("Stop printing single objects of a job", (), unsupported=("enable_exclude_object",))

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._objects: dict[str, _Object] = {}
        self._excluded: set[str] = set()
        self._current: str | None = None
        self._retracted_mm: float | None = None
        """While moves are left out: by how much the filament was drawn back when that began."""
        self.only_looks = False
        """Whether no moves are left out, whatever is excluded: a program is read again up to where it was."""
        for name, help_, read, while_printing in (
            ("EXCLUDE_OBJECT_DEFINE", "Define an object: NAME, CENTER, POLYGON", self._define, False),
            ("EXCLUDE_OBJECT_START", "Mark the begin of an object", self._start, False),
            ("EXCLUDE_OBJECT_END", "Mark the end of an object", self._end, False),
            ("EXCLUDE_OBJECT", "Stop printing an object", self._exclude, True),
        ):
            build.add_command(name, help_, read, while_printing=while_printing)

    def status(self) -> Mapping[str, Value]:
        """Report the objects, which of them are left out, and which one is being read."""
        return {
            "objects": [found.shown for found in tuple(self._objects.values())],
            "excluded_objects": self.excluded,
            "current_object": self._current,
        }

    def job_begins(self) -> None:
        """Forget the objects of another program."""
        self.forget()

    def outlines(self) -> list[list[tuple[float, float]]]:
        """Return the polygon of each object of the program, or its centre where it has none."""
        found = []
        for each in tuple(self._objects.values()):
            if each.polygon:
                found.append([*each.polygon])
            elif each.center is not None:
                found.append([each.center])
        return found

    @property
    def excluded(self) -> list[str]:
        """Names of the objects that are left out."""
        return sorted(self._excluded)

    @property
    def leaves_out(self) -> bool:
        """Whether what is being read is an excluded object."""
        return self._current in self._excluded

    def take_over(self, other: "ExcludeObject", excluded: Iterable[str]) -> None:
        """Know what OTHER has read of the program, and leave out EXCLUDED as well; before the first move."""
        self._objects = dict(other._objects)  # noqa: SLF001 (one of its kind)
        self._excluded = (other._excluded | set(excluded)) & self._objects.keys()  # noqa: SLF001
        self._current = other._current  # noqa: SLF001

    def begin_leaving_out(self, planner: "Planner") -> None:
        """Record that PLANNER leaves out moves: the program was in an excluded object before."""
        self._retracted_mm = planner.retracted_mm

    def forget(self) -> None:
        """Forget all objects."""
        self._objects.clear()
        self._excluded.clear()
        self._current = self._retracted_mm = None

    # ---- Commands of the program ----

    def _define(self, call: Call) -> Reading:
        values = call.parameters("NAME", "CENTER", "POLYGON", "RESET", "JSON")
        if flag(call.command, values, "RESET"):
            return ProgramAction(self._reset)
        if "NAME" not in values:
            known = " ".join(self._objects) or "none"
            if flag(call.command, values, "JSON"):
                known = json.dumps([found.shown for found in self._objects.values()])
            return Immediate((f"Known objects: {known}",))
        found = _Object(
            values["NAME"].upper(),
            _point(call.command, values["CENTER"].split(",")) if "CENTER" in values else None,
            _polygon(call.command, values.get("POLYGON", "[]")),
        )
        return Immediate(act=lambda: self._know(found))

    def _know(self, found: _Object) -> None:
        if found.name not in self._objects and len(self._objects) >= OBJECTS_MAX:
            raise WordError(f"the program has more than {OBJECTS_MAX} objects; leave some undefined")
        if len(found.name) > NAME_MAX:
            raise WordError(f"an object has a name of {len(found.name)} characters; {NAME_MAX} at most")
        points = sum(len(other.polygon) for other in self._objects.values() if other.name != found.name)
        fits = len(found.polygon) <= 4 or points + len(found.polygon) <= ALL_POINTS_MAX
        self._objects[found.name] = found if fits else found.simplified()

    def _reset(self, job: ProgramContext) -> bool:
        done = self._make_moves(job)
        if done:
            self.forget()
        return done

    def _start(self, call: Call) -> Reading:
        name = needed(call.command, call.parameters("NAME"), "NAME").upper()

        def act(job: ProgramContext) -> bool:
            if name not in self._objects:
                self._know(_Object(name))
            if not self._make_moves(job):
                return False
            self._current = name
            self._look(job)
            return True

        return ProgramAction(act)

    def _end(self, call: Call) -> Reading:
        name = call.parameters("NAME").get("NAME", "").upper()

        def act(job: ProgramContext) -> bool:
            if self._current is None or name not in {"", self._current}:
                # An object within another one: what comes behind it is of none, or still of the newer one.
                now = "no object is being printed" if self._current is None else f"it is {self._current}"
                job.notice(f"EXCLUDE_OBJECT_END {name}".strip(), f"{now}: the line is ignored")
                return True
            done = self._make_moves(job)
            if done:
                self._current = None
            return done

        return ProgramAction(act)

    # ---- Commands of the user ----

    def _exclude(self, call: Call) -> Reading:
        command = call.command
        values = call.parameters("NAME", "CURRENT", "RESET")
        name = values.get("NAME", "").upper()
        if flag(command, values, "RESET"):
            return ProgramAction(lambda job: self._take_back(job, name))
        if flag(command, values, "CURRENT"):
            name = self._current or ""
            if not name:
                raise WordError("EXCLUDE_OBJECT CURRENT=1 comes where no object is; name one by NAME=...")
        if not name:
            return Immediate((f"Excluded objects: {' '.join(sorted(self._excluded)) or 'none'}",))
        if name not in self._objects:
            hint = nearest_or_all(name, self._objects)
            raise WordError(f"EXCLUDE_OBJECT names {quoted(name)}, which is no object of this program{hint}")

        def act(job: ProgramContext) -> bool:
            self._excluded.add(name)
            self._look(job)
            return True

        return ProgramAction(act)

    def _take_back(self, job: ProgramContext, name: str) -> bool:
        if (not name or name == self._current) and not self._make_moves(job):
            return False
        if name:
            self._excluded.discard(name)
        else:
            self._excluded.clear()
        return True

    # ---- Excluding moves ----

    def _look(self, job: ProgramContext) -> None:
        """Leave out moves from here on, if this is an object to be left out."""
        if self.leaves_out and self._retracted_mm is None and not self.only_looks:
            self._retracted_mm = job.planner.retracted_mm
            job.planner.excluded = True

    def _make_moves(self, job: ProgramContext) -> bool:
        """Make moves again; False: the planner has to be emptied first."""
        if self._retracted_mm is None:
            return True
        if not job.planner.excluded:  # the program that left them out is over
            self._retracted_mm = None
            return True
        status = job.planner.end_exclusion(self._retracted_mm, _SPEED_MM_S)
        if status is FeedStatus.LIMIT:
            raise WordError(str(job.planner.fault))
        if status is FeedStatus.FULL:
            return False
        self._retracted_mm = None
        return True


def _status(found: _Object) -> Value:
    status: dict[str, Value] = {"name": found.name}
    if found.center is not None:
        status["center"] = list(found.center)
    if found.polygon:
        status["polygon"] = [list(point) for point in found.polygon]
    return status


def _point(command: Command, words: "list[str]") -> tuple[float, float]:
    if len(words) != 2:
        raise WordError(f"a point of {command.name} has {len(words)} numbers; give X and Y")
    x, y = (number(command.name, {"CENTER": word}, "CENTER") for word in words)
    return (x, y)


def _polygon(command: Command, text: str) -> tuple[tuple[float, float], ...]:
    try:
        points = json.loads(text)
    except (ValueError, RecursionError):
        points = None
    if not isinstance(points, list) or len(points) > POINTS_MAX:
        raise WordError(
            f"POLYGON of {command.name} is {quoted(text)}; write [[x,y],[x,y],...] without blanks, at most"
            f" {POINTS_MAX} points"
        )
    return tuple(_point(command, [str(value) for value in point]) for point in points if _is_list(point))


def _is_list(point: object) -> bool:
    return isinstance(point, list)

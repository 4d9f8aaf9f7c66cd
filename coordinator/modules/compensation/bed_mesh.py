"""[bed_mesh]: the bed is probed at many points, and Z follows its shape."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from coordinator.config.options import SectionSpec
from coordinator.config.sections.bounds import MAX_POSITION
from coordinator.gcode.builtins.machine import follow_surface
from coordinator.gcode.commands import (
    Call,
    Immediate,
    Phases,
    ProgramAction,
    ProgramContext,
    Reading,
)
from coordinator.gcode.events import Reply
from coordinator.gcode.parameters import bounded, flag, one, value
from coordinator.gcode.parser import Command, WordError
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.compensation.bed_mesh_options import (
    BY_PROBE,
    PARAMETERS,
    PROFILE,
    REGION,
    SETTINGS,
    UNSUPPORTED,
    MeshSettings,
    grid_for,
    profile_name,
    profile_texts,
    read_profile,
    read_settings,
)
from coordinator.modules.compensation.mesh import Grid, Heights, Mesh, Place, adapted, fitting_algorithm
from coordinator.modules.levelling.points import ProbePoints, how_to_measure
from coordinator.modules.probes.probe import Measured, Measuring, Probe
from coordinator.modules.programs.exclude_object import ExcludeObject
from coordinator.motion.steps.surface import Surface
from coordinator.support.values import Value
from nodes.support.errors import CanductorError

DEFAULT_PROFILE: Final = "default"
PROFILES_MAX: Final = 50
"""That a program may make; clients get all of them."""
DUMPED_MAX: Final = 1000
"""Points of a grid that a client may ask about; they are found and written on the control loop."""
RESTORE: Final = "_BED_MESH_RESTORE"


class BedMeshSection(Module):
    """The plain section has the settings, a named one is a profile."""

    SPEC = SectionSpec(
        "Z follows the shape of the bed; [bed_mesh NAME] is a profile that was saved",
        (*SETTINGS, *PROFILE),
        unsupported=UNSUPPORTED,
        family=REGION,
    )
    NAMED = True
    NAMELESS = True

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.profile = build.reader.section.instance
        mesh = build.shared(BedMesh)
        if self.profile:
            mesh.profiles[self.profile] = read_profile(build)
        else:
            mesh.set_up(read_settings(build), ProbePoints(build, by_probe=BY_PROBE))


@dataclass(frozen=True, slots=True)
class _Wanted:
    """What a calibration is to make."""

    grid: Grid
    algorithm: str
    profile: str


class BedMesh(Module):
    """The commands, and the mesh that Z follows."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.name = "bed_mesh"
        self.profiles: dict[str, Mesh] = {}
        self._shown: dict[str, Value] = {}
        """The same as front ends get them."""
        self._settings: MeshSettings | None = None
        self._points: ProbePoints | None = None
        self._calibration: dict[str, Value] = {}
        """Where BED_MESH_CALIBRATE probes without parameters."""
        self._limits = build.machine.limits
        self._mesh: Mesh | None = None
        self._surface: Surface | None = None
        self._fine: list[Value] = [[]]
        self._profile = ""
        self._offset: Place = (0.0, 0.0)
        self._fade_offset = 0.0
        self.to_restore: Mapping[str, Any] | None = None
        """What ``held`` returned before a crash."""
        self._probe: Probe | None = None
        self._objects: ExcludeObject | None = None
        for name, help_, read in (
            ("BED_MESH_CALIBRATE", "Probe the bed and let Z follow its shape", self._read_calibrate),
            ("BED_MESH_PROFILE", "LOAD, SAVE or REMOVE a profile by its name", self._read_profile),
            ("BED_MESH_CLEAR", "Let Z follow no mesh", self._read_clear),
            ("BED_MESH_OFFSET", "Look the mesh up X and Y further, its fade ZFADE higher", self._read_offset),
            ("BED_MESH_OUTPUT", "Report the mesh, or with PGP=1 where it is probed", self._read_output),
            ("BED_MESH_MAP", "Report the probed heights as JSON", self._read_map),
            (RESTORE, "Let Z follow the mesh that was followed before a crash", self._read_restore),
            ("BED_MESH_CHECK", "Fail if the mesh exceeds MAX_DEVIATION or MAX_SLOPE", self._read_check),
        ):
            build.add_command(name, help_, read)

    def set_up(self, settings: MeshSettings, points: ProbePoints) -> None:
        """Take over what the plain section says."""
        self._settings, self._points = settings, points
        algorithm = fitting_algorithm(settings.algorithm, settings.grid.counts)
        self._calibration = _calibration(settings, settings.grid, algorithm)

    def link(self, modules: Modules) -> None:
        """Find the probe, without which the bed is probed by hand; raises NotSupported."""
        if self._points is not None:
            self._probe = self._points.find_probe(modules)
        self._shown = {name: _as_status(mesh) for name, mesh in self.profiles.items()}
        self._objects = modules.find("exclude_object", ExcludeObject)

    def status(self) -> Mapping[str, Value]:
        """Report the mesh that is followed, and all profiles, as front ends draw them."""
        mesh = self._mesh
        return {
            "profile_name": self._profile,
            "mesh_min": [0.0, 0.0] if mesh is None else [*mesh.minimum],
            "mesh_max": [0.0, 0.0] if mesh is None else [*mesh.maximum],
            "probed_matrix": [[]] if mesh is None else _rows(mesh.heights),
            "mesh_matrix": [[]] if mesh is None else self._fine,
            "profiles": self._shown,
        }

    # ------------------------------------------------------------------------------------------- following

    def take(
        self,
        job: ProgramContext,
        mesh: Mesh | None,
        profile: str = "",
        offsets: tuple[Place, float] | None = None,
    ) -> bool:
        """Let Z follow MESH from here on; no motor moves. False: the planner has to be emptied first.

        OFFSETS: where it is looked up, and of its fade; None: as before. Raises WordError.
        """
        offset, fade_offset = offsets or (self._offset, self._fade_offset)
        surface = None
        if mesh is not None:
            assert self._settings is not None
            try:
                surface = mesh.surface(self._settings.fade.of(mesh, fade_offset), offset)
            except CanductorError as error:
                raise WordError(str(error)) from None
        if not follow_surface(job, surface):
            return False
        self._offset, self._fade_offset = offset, fade_offset
        self._mesh, self._profile, self._surface = mesh, profile, surface
        self._fine = [[]] if mesh is None else _rows(mesh.fine_heights())
        if surface is not None:
            fastest = self._limits.max_z_velocity / max(surface.steepest, 1e-9)
            if fastest < job.planner.max_velocity:
                job.emit(
                    Reply(
                        job.line,
                        f"the mesh is up to {surface.steepest:.4f} mm per mm steep: moves faster than"
                        f" {fastest:.0f} mm/s may move Z faster than max_z_velocity",
                    )
                )
        return True

    def dump(self, parameters: Mapping[str, object]) -> Mapping[str, Value]:
        """Return the mesh, all profiles, and where BED_MESH_CALIBRATE would probe; raises WordError.

        PARAMETERS are those of that command, by name; with them it has DUMPED_MAX points at most.
        """
        mesh, found = self._mesh, self.status()
        current: dict[str, Value] = {}
        if mesh is not None:
            current = {
                "name": self._profile,
                "probed_matrix": found["probed_matrix"],
                "mesh_matrix": found["mesh_matrix"],
                "mesh_params": _parameters(mesh),
            }
        offset = (0.0, 0.0, 0.0) if self._probe is None else self._probe.offset
        return {
            "current_mesh": current,
            "profiles": found["profiles"],
            "calibration": self._planned(parameters) if parameters else self._calibration,
            "probe_offsets": [*offset],
            "axis_minimum": [*self._limits.position_min, 0.0],
            "axis_maximum": [*self._limits.position_max, 0.0],
        }

    def _planned(self, parameters: Mapping[str, object]) -> dict[str, Value]:
        """Return where BED_MESH_CALIBRATE with PARAMETERS would probe."""
        if self._settings is None:
            return {}
        each = ((name.upper(), str(value).replace('"', "")) for name, value in parameters.items())
        text = " ".join(f'{name}="{value}"' for name, value in each)
        command = Command("BED_MESH_CALIBRATE", text)
        grid, algorithm = self._wanted(command)
        if math.prod(grid.counts) > DUMPED_MAX:
            raise WordError(
                f"{command.name}: a mesh of {grid.counts[0]}, {grid.counts[1]} points is too large to be"
                f" asked about, {DUMPED_MAX:,} are possible; ask for fewer, or without parameters"
            )
        return _calibration(self._settings, grid, algorithm)

    # ------------------------------------------------------------------------------------ after a crash

    def held(self) -> Mapping[str, Any] | None:
        """Return what RESTORE needs, for a journal; None: no mesh is followed."""
        mesh = self._mesh
        if mesh is None:
            return None
        return {
            "profile": self._profile,
            "heights": _rows(mesh.heights),
            "minimum": mesh.minimum,
            "maximum": mesh.maximum,
            "algorithm": mesh.algorithm,
            "tension": mesh.tension,
            "pps": mesh.pps,
            "offset": self._offset,
            "z_fade": self._fade_offset,
        }

    def added_mm(self, place: tuple[float, float, float]) -> float:
        """Return how much higher the motors are at a planned PLACE because of the mesh."""
        if self._surface is None:
            return 0.0
        return self._surface.motor_z(*place) - place[2]

    def _read_restore(self, call: Call) -> Reading:
        call.parameters()
        held = self.to_restore
        if held is None or self._settings is None:
            raise WordError("no mesh was followed before a crash")
        try:
            mesh = Mesh(
                _heights(held["heights"]),
                _pair(held["minimum"]),
                _pair(held["maximum"]),
                str(held["algorithm"]),
                float(held["tension"]),
                (int(held["pps"][0]), int(held["pps"][1])),
            )
            offset, fade_offset, profile = _pair(held["offset"]), float(held["z_fade"]), str(held["profile"])
        except (KeyError, IndexError, TypeError, ValueError):
            raise WordError("the mesh that was followed cannot be read") from None

        return ProgramAction(lambda job: self.take(job, mesh, profile, (offset, fade_offset)))

    # ----------------------------------------------------------------------------------------- calibrating

    def _read_calibrate(self, call: Call) -> Reading:
        if self._settings is None:
            raise WordError("BED_MESH_CALIBRATE needs the section [bed_mesh], which says where to probe")
        assert self._points is not None
        command = call.command
        how = how_to_measure(call, self._probe)
        given = command.only_parameters(PARAMETERS)
        grid, algorithm = self._wanted(command)
        profile = profile_name(command, given, "PROFILE") if "PROFILE" in given else DEFAULT_PROFILE
        self._check_room(command, profile)
        by = None if how is None or self._probe is None else (self._probe, how)
        self._points.check(call, None if by is None else by[0])
        wanted_mesh = _Wanted(grid, algorithm, profile)
        return Phases(lambda job: self._calibrate(job, call, by, wanted_mesh))

    def _wanted(self, command: Command) -> tuple[Grid, str]:
        """Return what COMMAND is to measure, and how its points are joined; raises WordError."""
        assert self._settings is not None
        given = command.only_parameters(PARAMETERS)
        grid = grid_for(command, given, self._settings.grid)
        if flag(command, given, "ADAPTIVE"):
            margin = bounded(command, given, "ADAPTIVE_MARGIN", self._settings.margin, low=0, high=1000)
            grid = adapted(grid, self._outlines(), margin)
        try:
            wanted = given.get("ALGORITHM", self._settings.algorithm).lower()
            return grid, fitting_algorithm(wanted, grid.counts)
        except ValueError as error:
            raise WordError(f"{command.name}: {error}") from None

    def _calibrate(
        self, job: ProgramContext, call: Call, by: tuple[Probe, Measuring] | None, wanted: "_Wanted"
    ) -> Iterator[Reading]:
        assert self._settings is not None
        assert self._points is not None
        yield ProgramAction(lambda job: self.take(job, None))
        places, zero = wanted.grid.places(), self._settings.zero
        if zero is not None and zero not in places:
            places.append(zero)

        def found(job: ProgramContext, measured: list[Measured]) -> Iterator[Reading]:
            del job
            height = {place: one.bed[2] for place, one in zip(places, measured, strict=True)}
            yield from self._measured(call, wanted, height)

        yield from self._points.collect(job, call, by, found, places=places)

    def _measured(self, call: Call, wanted: "_Wanted", height: Mapping[Place, float]) -> Iterator[Reading]:
        """Make a mesh of the bed's HEIGHT at the places of a grid, and follow it."""
        assert self._settings is not None
        grid, profile, zero = wanted.grid, wanted.profile, self._settings.zero
        try:
            reference = 0.0 if zero is None else height[zero]
            heights = grid.heights(lambda place: height[place] - reference)
        except ValueError as error:
            raise WordError(f"{call.command.name}: {error}") from None
        mesh = self._settings.mesh(grid, wanted.algorithm, heights)
        yield ProgramAction(lambda job: self.take(job, mesh, profile))
        lowest, highest = mesh.lowest + reference, mesh.highest + reference
        found = f"the bed is measured, from {lowest:.3f} to {highest:.3f} mm"
        kept = f"it is profile {profile}, which SAVE_CONFIG writes"
        yield Immediate((f"{found}; {kept}",), lambda: self._keep(profile, mesh))

    def _outlines(self) -> list[list[Place]]:
        """Return the outlines of the objects that are printed."""
        if self._objects is None:
            raise WordError("ADAPTIVE needs [exclude_object], which knows where the objects are; add it")
        return self._objects.outlines()

    def _keep(self, name: str, mesh: Mesh) -> None:
        self.profiles = {**self.profiles, name: mesh}
        self._shown = {**self._shown, name: _as_status(mesh)}
        if self._live is not None:
            self._live.save_soon(f"bed_mesh {name}", profile_texts(mesh))

    def _check_room(self, command: Command, name: str) -> None:
        if name not in self.profiles and len(self.profiles) >= PROFILES_MAX:
            raise WordError(f"{command.name}: there are {PROFILES_MAX} profiles already; remove one of them")

    # -------------------------------------------------------------------------------------- other commands

    def _read_profile(self, call: Call) -> Reading:
        given = call.parameters("LOAD", "SAVE", "REMOVE")
        if len(given) != 1:
            raise WordError("BED_MESH_PROFILE takes one of LOAD=name, SAVE=name and REMOVE=name")
        if "LOAD" in given:
            name = one(call.command, given, "LOAD", self.profiles)
            if self._settings is None:
                raise WordError("BED_MESH_PROFILE LOAD needs the section [bed_mesh]")
            return ProgramAction(lambda job: self.take(job, self.profiles[name], name))
        if "REMOVE" in given:
            name = one(call.command, given, "REMOVE", self.profiles)
            return Immediate(
                (f"profile {name} is removed",),
                lambda: self._remove(name),
            )
        name, mesh = profile_name(call.command, given, "SAVE"), self._mesh
        if mesh is None:
            raise WordError("BED_MESH_PROFILE SAVE: no mesh is followed; probe one with BED_MESH_CALIBRATE")
        self._check_room(call.command, name)
        return Immediate((f"profile {name} is saved; SAVE_CONFIG writes it",), lambda: self._keep(name, mesh))

    def _remove(self, name: str) -> None:
        self.profiles = {other: mesh for other, mesh in self.profiles.items() if other != name}
        self._shown = {other: shown for other, shown in self._shown.items() if other != name}
        live = self._live
        if live is None:
            return

        def drop() -> None:
            if live.drop_saved(f"bed_mesh {name}"):
                live.say(f"SAVE_CONFIG removes profile {name} from the file")

        live.soon_on_loop(drop)

    def _read_clear(self, call: Call) -> Reading:
        call.parameters()
        return ProgramAction(lambda job: self._mesh is None or self.take(job, None))

    def _read_offset(self, call: Call) -> Reading:
        given = call.parameters("X", "Y", "ZFADE")
        x, y, fade = (
            bounded(call.command, given, key, 0.0, low=-MAX_POSITION, high=MAX_POSITION)
            for key in ("X", "Y", "ZFADE")
        )

        def act(job: ProgramContext) -> bool:
            offset = (x if "X" in given else self._offset[0], y if "Y" in given else self._offset[1])
            fade_offset = fade if "ZFADE" in given else self._fade_offset
            if self._mesh is not None:
                return self.take(job, self._mesh, self._profile, (offset, fade_offset))
            self._offset, self._fade_offset = offset, fade_offset
            return True

        return ProgramAction(act)

    def _read_output(self, call: Call) -> Reading:
        given = call.parameters("PGP")
        if flag(call.command, given, "PGP"):
            if self._settings is None:
                raise WordError("BED_MESH_OUTPUT PGP=1 needs the section [bed_mesh]")
            places = self._settings.grid.places()
            return Immediate(tuple(f"{n} | {x:.2f}, {y:.2f}" for n, (x, y) in enumerate(places)))
        mesh = self._followed(call)
        (x0, y0), (x1, y1) = mesh.minimum, mesh.maximum
        title = (
            f"profile {self._profile or '(none)'}, {mesh.algorithm}, X {x0:g} to {x1:g}, Y {y0:g} to {y1:g}"
        )
        rows = (" ".join(f"{height:9.6f}" for height in row) for row in mesh.heights)
        return Immediate((f"{title}, heights in mm:", *rows))

    def _read_map(self, call: Call) -> Reading:
        call.parameters()
        mesh = self._followed(call)
        found = {"mesh_min": mesh.minimum, "mesh_max": mesh.maximum, "z_positions": _rows(mesh.heights)}
        return Immediate((f"mesh_map_output {json.dumps(found)}",))

    def _read_check(self, call: Call) -> Reading:
        given = call.parameters("MAX_DEVIATION", "MAX_SLOPE")
        mesh = self._followed(call)
        found = {"MAX_DEVIATION": mesh.highest - mesh.lowest, "MAX_SLOPE": mesh.steepest}
        for key, text in (
            ("MAX_DEVIATION", "mm from its lowest to its highest"),
            ("MAX_SLOPE", "mm per mm steep"),
        ):
            most = value(call.command, given, key, math.inf)
            if found[key] > most:
                raise WordError(f"the mesh is {found[key]:.4f} {text}; {key} allows {most:g}")
        return Immediate(("the mesh is within the limits",))

    def _followed(self, call: Call) -> Mesh:
        if self._mesh is None:
            raise WordError(f"{call.command.name}: no mesh is followed; BED_MESH_CALIBRATE probes one")
        return self._mesh


def _calibration(settings: MeshSettings, grid: Grid, algorithm: str) -> dict[str, Value]:
    """Return where GRID is probed, as front ends get it."""
    path: list[Value] = [[x, y] for x, y in grid.places()]
    config: dict[str, Value] = {
        "x_count": grid.counts[0],
        "y_count": grid.counts[1],
        "mesh_x_pps": settings.pps[0],
        "mesh_y_pps": settings.pps[1],
        "algo": algorithm,
        "tension": settings.tension,
        "min_x": grid.minimum[0],
        "max_x": grid.maximum[0],
        "min_y": grid.minimum[1],
        "max_y": grid.maximum[1],
    }
    rapid: list[Value] = [[place, True] for place in path]
    return {"points": path, "config": config, "probe_path": path, "rapid_path": rapid}


def _pair(numbers: Sequence[Any]) -> Place:
    x, y = numbers
    return float(x), float(y)


def _heights(rows: Sequence[Sequence[Any]]) -> Heights:
    """Return ROWS as heights; raises TypeError, ValueError."""
    heights = tuple(tuple(float(height) for height in row) for row in rows)
    if not heights or len(set(map(len, heights))) != 1:
        raise ValueError("the rows of a mesh are not equally long")
    return heights


def _rows(heights: Heights) -> list[Value]:
    return [[round(height, 6) for height in row] for row in heights]


def _as_status(mesh: Mesh) -> dict[str, Value]:
    return {
        "points": _rows(mesh.heights),
        "mesh_params": _parameters(mesh),
    }


def _parameters(mesh: Mesh) -> dict[str, Value]:
    return {
        "min_x": mesh.minimum[0],
        "max_x": mesh.maximum[0],
        "min_y": mesh.minimum[1],
        "max_y": mesh.maximum[1],
        "x_count": mesh.counts[0],
        "y_count": mesh.counts[1],
        "mesh_x_pps": mesh.pps[0],
        "mesh_y_pps": mesh.pps[1],
        "algo": mesh.algorithm,
        "tension": mesh.tension,
    }

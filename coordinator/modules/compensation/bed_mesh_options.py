"""Options of [bed_mesh], which says where the bed is probed, and of its saved profiles [bed_mesh NAME]."""

import math
import re
from dataclasses import dataclass, replace
from typing import Any, Final

from coordinator.config.errors import ConfigError
from coordinator.config.options import BadValue, BoolOption, ChoiceOption, FloatOption, IntOption, Option
from coordinator.config.sections.bounds import MAX_POSITION
from coordinator.gcode.parser import Command, WordError, quoted
from coordinator.modules.base import Build
from coordinator.modules.compensation.mesh import (
    BICUBIC,
    LAGRANGE,
    Grid,
    Heights,
    Mesh,
    Place,
    Region,
    fitting_algorithm,
)
from coordinator.modules.levelling.points import HEIGHT, TRAVEL_SPEED
from coordinator.motion.steps.surface import NO_FADE
from coordinator.support.quoting import shown

NAME_MAX: Final = 100
"""Characters of a profile's name."""
POINTS_MAX: Final = 100
"""Along an axis."""
REGIONS: Final = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class PairOption(Option[tuple[float, float]]):
    """Two numbers with a comma between them, or one that stands for both."""

    minimum: float = -MAX_POSITION
    maximum: float = MAX_POSITION
    whole_numbers: bool = False
    one_for_both: bool = False

    def parse(self, text: str) -> tuple[float, float]:
        """Return them."""
        bounds = {"name": "", "help": "", "minimum": self.minimum, "maximum": self.maximum}
        number: Option[Any] = (IntOption if self.whole_numbers else FloatOption)(**bounds)  # type: ignore[arg-type]
        words = text.split(",")
        if len(words) == 1 and self.one_for_both:
            words *= 2
        if len(words) != 2:
            raise BadValue
        x, y = (number.parse(word.strip()) for word in words)
        return x, y

    def rule(self) -> str:
        """Return what is allowed."""
        noun = "whole numbers" if self.whole_numbers else "numbers"
        one = ", or one for both" if self.one_for_both else ""
        return f"two {noun} from {self.minimum:g} to {self.maximum:g} with a comma between them (X, Y){one}"

    def stand_in(self) -> tuple[float, float]:
        """Return any pair."""
        return (max(self.minimum, 3), max(self.minimum, 3))

    def setting(self, text: str, value: tuple[float, float]) -> object:
        """Return both as a list."""
        del text
        return [*value]


@dataclass(frozen=True, slots=True, kw_only=True)
class RowsOption(Option[tuple[tuple[float, ...], ...]]):
    """Rows of numbers, a line each."""

    def parse(self, text: str) -> tuple[tuple[float, ...], ...]:
        """Return them."""
        number = FloatOption(name="", help="", minimum=-100, maximum=100)
        lines = [line for line in text.splitlines() if line.strip()]
        rows = tuple(tuple(number.parse(word.strip()) for word in line.split(",")) for line in lines)
        if len(rows) < 2 or len(rows[0]) < 2 or len({len(row) for row in rows}) > 1:
            raise BadValue
        return rows

    def rule(self) -> str:
        """Return what is allowed."""
        return "two or more rows of equally many heights in mm, with commas between them"

    def stand_in(self) -> tuple[tuple[float, ...], ...]:
        """Return a level bed."""
        return ((0.0,) * 3,) * 3

    def setting(self, text: str, value: tuple[tuple[float, ...], ...]) -> object:
        """Return them as lists."""
        del text
        return [[*row] for row in value]


def _length(name: str, text: str, default: float | None = None, **bounds: float) -> FloatOption:
    limits = {"minimum": -MAX_POSITION, "maximum": MAX_POSITION} | bounds
    return FloatOption(name=name, help=text, default=default, unit="mm", **limits)


BY_PROBE: Final = BoolOption(
    name="use_probe_xy_offsets",
    help="whether the points are those of the probe; else those of the nozzle",
    default=True,
)
MESH_MIN: Final = PairOption(
    name="mesh_min", help="first point of the mesh (of a rectangular bed)", unit="mm"
)
MESH_MAX: Final = PairOption(name="mesh_max", help="last point of the mesh (of a rectangular bed)", unit="mm")
PROBE_COUNT: Final = PairOption(
    name="probe_count",
    help="points along X and along Y",
    default=(3, 3),
    minimum=3,
    maximum=POINTS_MAX,
    whole_numbers=True,
    one_for_both=True,
)
MESH_RADIUS: Final = _length("mesh_radius", "radius of the mesh, of a round bed", minimum=1)
MESH_ORIGIN: Final = PairOption(name="mesh_origin", help="centre of a round mesh", default=(0, 0), unit="mm")
ROUND_COUNT: Final = IntOption(
    name="round_probe_count",
    help="points across a round mesh; an odd number",
    default=5,
    minimum=3,
    maximum=POINTS_MAX - 1,
)
PPS: Final = PairOption(
    name="mesh_pps",
    help="points between two probed ones that the status shows; what Z follows is smooth",
    default=(2, 2),
    minimum=0,
    maximum=20,
    whole_numbers=True,
    one_for_both=True,
)
ALGORITHM: Final = ChoiceOption(
    name="algorithm",
    help="how points are joined: polynomials of 3 to 6 points, or cubics",
    default=LAGRANGE,
    choices=(LAGRANGE, BICUBIC),
)
TENSION: Final = FloatOption(
    name="bicubic_tension",
    help="of bicubic: slope at a point as a share of the difference of its neighbours",
    default=0.2,
    minimum=0,
    maximum=2,
)
FADE_START: Final = _length("fade_start", "Z up to which the whole mesh is followed", 1.0)
FADE_END: Final = _length(
    "fade_end", "Z from which it is not followed any more; up to fade_start: it always is", 0.0
)
FADE_TARGET: Final = _length(
    "fade_target", "height that stays above fade_end; by default the mesh's mean, without fade 0"
)
ZERO: Final = PairOption(
    name="zero_reference_position", help="where the mesh is 0 high; it is probed, too", unit="mm"
)
MARGIN: Final = _length(
    "adaptive_margin", "how far an adaptive mesh reaches beyond the objects", 0.0, minimum=0
)
REGION: Final = PairOption(
    name="faulty_region_",
    help="N_min, N_max: corners of region N (1 to 20) that is not probed, such as above a magnet",
    unit="mm",
)
_GRID: Final[tuple[Option[Any], ...]] = (
    MESH_MIN,
    MESH_MAX,
    PROBE_COUNT,
    MESH_RADIUS,
    MESH_ORIGIN,
    ROUND_COUNT,
)
_SHAPE: Final[tuple[Option[Any], ...]] = (
    PPS,
    ALGORITHM,
    TENSION,
    FADE_START,
    FADE_END,
    FADE_TARGET,
    ZERO,
    MARGIN,
)
SETTINGS: Final[tuple[Option[Any], ...]] = (TRAVEL_SPEED, HEIGHT, BY_PROBE, *_GRID, *_SHAPE)
UNSUPPORTED: Final = (
    *("split_delta_z", "move_check_distance", "scan_overshoot", "horizontal_z_clearance"),
    "bed_mesh_default",
)

VERSION: Final = IntOption(name="version", help="of a profile's options", default=1, minimum=1, maximum=1)
POINTS: Final = RowsOption(name="points", help="heights of a profile, a row of X a line", unit="mm")
X_COUNT: Final = IntOption(name="x_count", help="points along X of a profile", minimum=2)
Y_COUNT: Final = IntOption(name="y_count", help="points along Y of a profile", minimum=2)
X_PPS: Final = IntOption(
    name="mesh_x_pps", help="mesh_pps along X of a profile", default=2, minimum=0, maximum=20
)
Y_PPS: Final = IntOption(
    name="mesh_y_pps", help="mesh_pps along Y of a profile", default=2, minimum=0, maximum=20
)
ALGO: Final = ChoiceOption(
    name="algo", help="algorithm of a profile", default=LAGRANGE, choices=(LAGRANGE, BICUBIC, "direct")
)
PROFILE_TENSION: Final = replace(TENSION, name="tension", help="bicubic_tension of a profile")
BORDERS: Final = tuple(
    _length(name, f"{which} point of a profile along {name[-1].upper()}")
    for name, which in (("min_x", "first"), ("max_x", "last"), ("min_y", "first"), ("max_y", "last"))
)
PROFILE: Final[tuple[Option[Any], ...]] = (
    VERSION,
    POINTS,
    X_COUNT,
    Y_COUNT,
    X_PPS,
    Y_PPS,
    ALGO,
    PROFILE_TENSION,
    *BORDERS,
)


@dataclass(frozen=True, slots=True)
class Fade:
    """Where a mesh is followed less and less."""

    start: float
    end: float
    target: float | None

    def of(self, mesh: Mesh, z_offset: float = 0.0) -> tuple[float, float, float]:
        """Return it as a surface needs it for MESH, looked up Z_OFFSET higher."""
        if self.end <= self.start:
            return NO_FADE
        target = mesh.mean if self.target is None else self.target
        return (self.start - z_offset, self.end - z_offset, target)


@dataclass(frozen=True, slots=True)
class MeshSettings:
    """What [bed_mesh] says."""

    grid: Grid
    algorithm: str
    tension: float
    pps: tuple[int, int]
    fade: Fade
    zero: Place | None
    margin: float

    def mesh(self, grid: Grid, algorithm: str, heights: Heights) -> Mesh:
        """Return the mesh of HEIGHTS of GRID."""
        return Mesh(heights, grid.minimum, grid.maximum, algorithm, self.tension, self.pps)


def read_settings(build: Build) -> MeshSettings:
    """Return what the plain section says; raises ConfigError."""
    fade = Fade(build.get(FADE_START), build.get(FADE_END), build.find(FADE_TARGET))
    px, py = build.get(PPS)
    settings = MeshSettings(
        _grid(build),
        build.get(ALGORITHM),
        build.get(TENSION),
        (int(px), int(py)),
        fade,
        build.find(ZERO),
        build.get(MARGIN),
    )
    try:
        fitting_algorithm(settings.algorithm, settings.grid.counts)
    except ValueError as error:
        raise ConfigError(build.place, f"[{build.name}]: {error}") from None
    return settings


def _grid(build: Build) -> Grid:
    regions = _regions(build)
    radius = build.find(MESH_RADIUS)
    if radius is not None:
        count = build.get(ROUND_COUNT)
        if count % 2 == 0:
            raise build.reader.bad(ROUND_COUNT, "which is even; a round mesh has a point in its centre")
        for option in (MESH_MIN, MESH_MAX):
            if build.find(option) is not None:
                raise build.reader.bad(option, "but mesh_radius is for a round bed; remove one of them")
        return _round(build.get(MESH_ORIGIN), radius, count, regions)
    first, last, counts = build.get(MESH_MIN), build.get(MESH_MAX), build.get(PROBE_COUNT)
    if not (first[0] < last[0] and first[1] < last[1]):
        raise build.reader.bad(MESH_MAX, f"which is not beyond mesh_min, {first[0]:g}, {first[1]:g}")
    return Grid(first, last, (int(counts[0]), int(counts[1])), regions=regions)


def _round(center: Place, radius: float, count: int, regions: tuple[Region, ...]) -> Grid:
    x, y = center
    return Grid((x - radius, y - radius), (x + radius, y + radius), (count, count), center, radius, regions)


def _regions(build: Build) -> tuple[Region, ...]:
    corners: dict[str, dict[str, Place]] = {}
    for rest, raw in build.reader.family().items():
        name = f"{REGION.name}{rest}"
        written = re.fullmatch(r"([0-9]{1,2})_(min|max)", rest)
        if written is None or not 1 <= int(written[1]) <= REGIONS:
            raise ConfigError(
                raw.place,
                f"'{name}' of [{build.name}] is unknown; N of faulty_region_N_min is 1 to {REGIONS}",
            )
        try:
            corner = REGION.parse(raw.value)
        except BadValue as error:
            why = str(error) or f"it must be {REGION.rule()}"
            raise ConfigError(raw.place, f"'{name}' of [{build.name}] is {shown(raw.value)}; {why}") from None
        corners.setdefault(written[1], {})[written[2]] = corner
        build.reader.section.used[name] = [*corner]
    found = []
    for number, both in corners.items():
        if both.keys() != {"min", "max"}:
            raise ConfigError(
                build.place,
                f"[{build.name}] has one corner of faulty region {number}; give its _min and _max",
            )
        region = Region(both["min"], both["max"])
        if not (region.minimum[0] < region.maximum[0] and region.minimum[1] < region.maximum[1]):
            raise ConfigError(
                build.place,
                f"[{build.name}]: faulty_region_{number}_max is not beyond its _min",
            )
        found.append(region)
    return tuple(found)


def read_profile(build: Build) -> Mesh:
    """Return the mesh of a named section; raises ConfigError."""
    build.get(VERSION)
    heights = build.get(POINTS)
    counts = (build.get(X_COUNT), build.get(Y_COUNT))
    rows, columns = len(heights), len(heights[0])
    if (columns, rows) != counts:
        raise build.reader.bad(
            POINTS, f"{rows} rows of {columns}; x_count and y_count say {counts[1]} rows of {counts[0]}"
        )
    x0, x1, y0, y1 = (build.get(option) for option in BORDERS)
    if not (x0 < x1 and y0 < y1):
        raise ConfigError(build.place, f"[{build.name}]: max_x and max_y have to be beyond min_x and min_y")
    wanted = build.get(ALGO)
    try:
        algorithm = fitting_algorithm(LAGRANGE if wanted == "direct" else wanted, counts)
    except ValueError as error:
        raise ConfigError(build.place, f"[{build.name}]: {error}") from None
    pps = (build.get(X_PPS), build.get(Y_PPS))
    return Mesh(heights, (x0, y0), (x1, y1), algorithm, build.get(PROFILE_TENSION), pps)


def profile_texts(mesh: Mesh) -> dict[str, str]:
    """Return a profile's options as text."""
    rows = "\n".join(", ".join(f"{height:.6f}" for height in row) for row in mesh.heights)
    return {
        "version": "1",
        "points": "\n" + rows,
        "x_count": str(mesh.counts[0]),
        "y_count": str(mesh.counts[1]),
        "mesh_x_pps": str(mesh.pps[0]),
        "mesh_y_pps": str(mesh.pps[1]),
        "algo": mesh.algorithm,
        "tension": f"{mesh.tension:g}",
        "min_x": f"{mesh.minimum[0]:g}",
        "max_x": f"{mesh.maximum[0]:g}",
        "min_y": f"{mesh.minimum[1]:g}",
        "max_y": f"{mesh.maximum[1]:g}",
    }


# -------------------------------------------------------------------------------- parameters of the command

PARAMETERS: Final = (
    *("MESH_MIN", "MESH_MAX", "PROBE_COUNT", "MESH_RADIUS", "MESH_ORIGIN", "ROUND_PROBE_COUNT", "ALGORITHM"),
    *("ADAPTIVE", "ADAPTIVE_MARGIN", "METHOD", "PROFILE"),
)


def grid_for(command: Command, given: dict[str, str], grid: Grid) -> Grid:
    """Return GRID with what GIVEN parameters of COMMAND change of it; raises WordError."""

    def read(option: Option[Any], key: str, default: Any) -> Any:
        if key not in given:
            return default
        try:
            return option.parse(given[key])
        except BadValue as error:
            why = str(error) or f"it must be {option.rule()}"
            raise WordError(f"{key} of {command.name} is {quoted(given[key])}; {why}") from None

    if math.isfinite(grid.radius):
        count = read(ROUND_COUNT, "ROUND_PROBE_COUNT", grid.counts[0])
        if count % 2 == 0:
            raise WordError(f"ROUND_PROBE_COUNT of {command.name} is {count}; give an odd number")
        center = read(MESH_ORIGIN, "MESH_ORIGIN", grid.center)
        return _round(center, read(MESH_RADIUS, "MESH_RADIUS", grid.radius), count, grid.regions)
    first, last = read(MESH_MIN, "MESH_MIN", grid.minimum), read(MESH_MAX, "MESH_MAX", grid.maximum)
    if not (first[0] < last[0] and first[1] < last[1]):
        raise WordError(f"{command.name}: MESH_MAX is not beyond MESH_MIN")
    columns, rows = read(PROBE_COUNT, "PROBE_COUNT", grid.counts)
    return replace(grid, minimum=first, maximum=last, counts=(int(columns), int(rows)))


def profile_name(command: Command, given: dict[str, str], key: str) -> str:
    """Return the name of a profile to be saved; raises WordError."""
    name = given[key]
    if not re.fullmatch(r"[\w.-][\w .-]*", name) or " ".join(name.split()) != name or len(name) > NAME_MAX:
        raise WordError(
            f"{command.name}: {quoted(name)} cannot be a profile's name; take letters, digits, - and _,"
            f" {NAME_MAX} at most"
        )
    return name

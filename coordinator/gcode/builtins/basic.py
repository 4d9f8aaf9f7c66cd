"""The commands that every machine has: modes, dwells, homing, limits. The hot path of moves is in C."""

from collections.abc import Callable, Mapping

from coordinator.gcode.builtins import machine as machine_commands
from coordinator.gcode.builtins import state as state_commands
from coordinator.gcode.builtins import tuning as tuning_commands
from coordinator.gcode.commands import AtStandstill, ProgramContext
from coordinator.gcode.events import Done, Emergency, Reply, Wait
from coordinator.gcode.parameters import bounded, numbers
from coordinator.gcode.parser import Command, WordError, number
from coordinator.gcode.reply_kinds import ReplyKind
from coordinator.motion.planner.language import ARC_LETTERS, Plane
from coordinator.motion.planner.planner import AXIS_LETTERS, MOVE_LETTERS, FeedStatus

Handler = Callable[[ProgramContext, Command], bool]
"""Acts on a command; False when the planner must be emptied first and the line comes again. Before it
returns False it changes nothing but the planner's queue."""

MAX_DWELL_S = 86400.0


def _positive(command: Command, words: Mapping[str, float]) -> None:
    for letter, value in words.items():
        if value <= 0:
            raise WordError(f"{letter} of {command.name} is {value:g}; it must be above 0")


def _move(job: ProgramContext, command: Command) -> bool:
    """G0, G1 that the hot path refused: unusual words, or numbers of many digits."""
    words = command.words(MOVE_LETTERS)
    for letter in words.keys() - set(MOVE_LETTERS):
        job.notice(f"word {letter} of {command.name}", "it has no meaning here and is ignored")
    values = {letter: number(command.name, words, letter) for letter in words if letter in MOVE_LETTERS}
    status = job.planner.move(values)
    if status is FeedStatus.LIMIT:
        raise WordError(str(job.planner.fault))
    return status is not FeedStatus.FULL


def _dwell(job: ProgramContext, command: Command) -> bool:
    words = numbers(command, "PS")
    seconds = words.get("P", 0.0) / 1000 + words.get("S", 0.0)
    if not 0 <= seconds <= MAX_DWELL_S:
        raise WordError(f"G4 is to wait {seconds:g} s; 0 to {MAX_DWELL_S:g} s are possible")
    if not job.planner.flush():
        return False
    job.planner.dwell(seconds)
    return True


def _set(attribute: str, value: object) -> Handler:
    """Return what sets an ATTRIBUTE of the planner to VALUE."""

    def handle(job: ProgramContext, _command: Command) -> bool:
        setattr(job.planner, attribute, value)
        return True

    return handle


def _home(job: ProgramContext, command: Command) -> bool:
    named = [axis for axis in command.words() if axis in "XYZ"]
    axes = "".join(sorted(named or job.homed_position))
    for axis in axes:
        if axis not in job.homed_position:
            raise WordError(f"G28 names the axis {axis}, which this machine does not have")
    if not machine_commands.come_to_standstill(job):
        return False
    x, y, z, e = (
        job.homed_position[letter] if letter in axes else now
        for letter, now in zip(AXIS_LETTERS, job.planner.toolhead_position, strict=True)
    )
    home = Done(position=(x, y, z, e), homed=axes)
    if job.vocabulary.home is None:
        job.notice("G28", "there are no endstops to look for; the axes are taken as already home")
        job.take(home)
        return True
    reading = job.vocabulary.home(job.call(command), axes)
    if isinstance(reading, AtStandstill):
        reading = AtStandstill(reading.perform, home)
    return job.follow(command, reading)


def _set_origin(job: ProgramContext, command: Command) -> bool:
    words = numbers(command, AXIS_LETTERS)
    if command.text and not words:
        return True  # only what has no meaning: that is not the bare G92
    job.planner.set_gcode_position(words or dict.fromkeys(AXIS_LETTERS, 0.0))
    return True


def _set_accel(job: ProgramContext, command: Command) -> bool:
    """M204 that the hot path refused: above what is configured, or of unusual words."""
    words = numbers(command, "SPTR")
    words.pop("R", None)
    _positive(command, words)
    if "S" in words:
        words = {"S": words["S"]}
    for accel in words.values():
        _cap(job, "the acceleration", accel, job.planner.limits.max_accel)
    job.planner.set_accel_words(words)
    return True


def _limit_axes(what: str) -> Handler:
    def handle(job: ProgramContext, command: Command) -> bool:
        """M201, M203: what slicers write as the machine's limits; those of the configuration hold, too."""
        words = numbers(command, AXIS_LETTERS)
        _positive(command, words)
        job.planner.limit_axes(what, words)
        return True

    return handle


def _set_jerk(job: ProgramContext, command: Command) -> bool:
    """M205: the lesser of X and Y is the speed at a right-angled corner; the rest means nothing here."""
    corner = list(numbers(command, "XY").values())
    if corner:
        _positive(command, {"X or Y": min(corner)})
        job.planner.square_corner_velocity = min(*corner, job.planner.limits.square_corner_velocity)
    return True


def _cap(job: ProgramContext, what: str, asked: float, limit: float) -> None:
    if asked > limit:
        job.notice(f"{what} {asked:g} is above the configured {limit:g}", f"{limit:g} is used")


def _set_velocity_limit(job: ProgramContext, command: Command) -> bool:
    planner, limits = job.planner, job.planner.limits
    given = command.only_parameters(("VELOCITY", "ACCEL", "SQUARE_CORNER_VELOCITY", "MINIMUM_CRUISE_RATIO"))
    velocity = bounded(command, given, "VELOCITY", None, low=1e-3, high=1e9)
    accel = bounded(command, given, "ACCEL", None, low=1e-3, high=1e9)
    corner = bounded(command, given, "SQUARE_CORNER_VELOCITY", None, low=0, high=1e9)
    ratio = bounded(command, given, "MINIMUM_CRUISE_RATIO", None, low=0, high=0.999)
    if velocity is not None:
        _cap(job, "the velocity", velocity, limits.max_velocity)
        planner.max_velocity = velocity
    if accel is not None:
        _cap(job, "the acceleration", accel, limits.max_accel)
        planner.accel = accel
    if corner is not None:
        _cap(job, "the square corner velocity", corner, limits.square_corner_velocity)
        planner.square_corner_velocity = corner
    if ratio is not None:
        planner.minimum_cruise_ratio = ratio
    return True


def _reset_velocity_limit(job: ProgramContext, command: Command) -> bool:
    """RESET_VELOCITY_LIMIT: what the configuration says, of speeds and accelerations along the path."""
    command.only_parameters(())
    job.planner.reset_dynamics()
    return True


def _factor(job: ProgramContext, command: Command) -> bool:
    """M220, M221: percent in S; without it, nothing changes."""
    percent = numbers(command, "S").get("S")
    if percent is None:
        return True
    if not 1 <= percent <= 1000:
        raise WordError(f"S of {command.name} is {percent:g} %; 1 to 1000 % are possible")
    if command.name == "M220":
        job.planner.speed_factor = percent / 100
    else:
        job.planner.extrude_factor = percent / 100
    return True


def _wait_for_moves(job: ProgramContext, _command: Command) -> bool:
    if not job.planner.flush():
        return False
    job.emit(Wait(job.line, job.planner.print_time_end_s))
    return True


def _report_position(job: ProgramContext, _command: Command) -> bool:
    position = zip(AXIS_LETTERS, job.planner.gcode_position, strict=True)
    job.emit(
        Reply(job.line, " ".join(f"{letter}:{value:.3f}" for letter, value in position), ReplyKind.PLAIN)
    )
    return True


def _emergency(job: ProgramContext, _command: Command) -> bool:
    job.end_with(Emergency(job.line))
    return True


def _without_module(what: str) -> Handler:
    def handle(job: ProgramContext, _command: Command) -> bool:
        job.notice(what, "accepted, but without effect: no section of the configuration is for them")
        return True

    return handle


def _ignore(_job: ProgramContext, _command: Command) -> bool:
    return True


def _say(job: ProgramContext, command: Command) -> bool:
    job.emit(Reply(job.line, f"echo: {command.text.strip()}", ReplyKind.PLAIN))
    return True


def _refuse_spline(_job: ProgramContext, command: Command) -> bool:
    raise WordError(f"{command.name} curves are not supported; have the slicer write straight moves (G1)")


def _arc(job: ProgramContext, command: Command) -> bool:
    """G2, G3 that the hot path refused: unusual words, an impossible arc."""
    planner = job.planner
    if not planner.arc_open:
        words = command.words(ARC_LETTERS)
        for letter in words.keys() - set(ARC_LETTERS):
            job.notice(f"word {letter} of {command.name}", "it has no meaning here and is ignored")
        values = {letter: number(command.name, words, letter) for letter in words if letter in ARC_LETTERS}
        fault = planner.begin_arc(values, clockwise=command.name.startswith("G2"))
        if fault is not None:
            raise WordError(f"{command.name} {fault}")
    status = planner.go_on_with_arc()
    if status is FeedStatus.LIMIT:
        raise WordError(str(planner.fault))
    return status is not FeedStatus.FULL


_HEATS = ("M104", "M109", "M140", "M190")
_without_heater = _without_module("heater and fan commands")


def _heat(job: ProgramContext, command: Command) -> bool:
    """Accept what is for a heater or fan that the machine does not have, not for one that does not act."""
    why = job.vocabulary.unsupported.get(command.name)
    if why is None:
        return _without_heater(job, command)
    words = command.words("SRT")
    asks = [letter for letter in "SR" if letter in words and number(command.name, words, letter) > 0]
    if command.name in _HEATS and asks:
        job.refuse_skipping(command, f"heats, but {why}")
    else:
        job.notice(command.name, why)
    return True


_motors_off = _without_module("motor-off commands")
WHILE_PRINTING = frozenset(
    (
        *("M73", "M105", "M112", "M114", "M117", "M118", "M204", "M220", "M221"),
        *(
            "GET_POSITION",
            "RESET_VELOCITY_LIMIT",
            "SET_GCODE_OFFSET",
            "SET_PRESSURE_ADVANCE",
            "SET_VELOCITY_LIMIT",
            "TUNING_TOWER",
        ),
    )
)
"""Commands that neither move nor wait: a client may give them while a job prints."""
HANDLERS: Mapping[str, Handler] = {
    "G0": _move,
    "G1": _move,
    **dict.fromkeys(("G2", "G3"), _arc),
    "G5": _refuse_spline,
    "G4": _dwell,
    "G17": _set("plane", Plane.XY),
    "G18": _set("plane", Plane.ZX),
    "G19": _set("plane", Plane.YZ),
    "G20": _set("unit_mm", 25.4),
    "G21": _set("unit_mm", 1.0),
    "G28": _home,
    "G90": _set("relative", False),
    "G91": _set("relative", True),
    "G92": _set_origin,
    **dict.fromkeys(("M18", "M84"), _motors_off),
    **dict.fromkeys(("M73", "M117"), _ignore),
    "M118": _say,
    "M82": _set("relative_extrusion", False),
    "M83": _set("relative_extrusion", True),
    **dict.fromkeys(("M104", "M105", "M106", "M107", "M109", "M140", "M190"), _heat),
    "M112": _emergency,
    "M114": _report_position,
    "M201": _limit_axes("accel"),
    "M203": _limit_axes("velocity"),
    "M204": _set_accel,
    "M205": _set_jerk,
    **dict.fromkeys(("M220", "M221"), _factor),
    "M400": _wait_for_moves,
    "RESET_VELOCITY_LIMIT": _reset_velocity_limit,
    "SET_VELOCITY_LIMIT": _set_velocity_limit,
    **machine_commands.HANDLERS,
    **state_commands.HANDLERS,
    **tuning_commands.HANDLERS,
}

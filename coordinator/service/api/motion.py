"""Methods that move: g-code lines, single moves; and positions in all frames."""

import asyncio
import contextlib
from collections.abc import Awaitable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

from coordinator.gcode.builtins.basic import HANDLERS, WHILE_PRINTING
from coordinator.gcode.builtins.machine import is_tool
from coordinator.gcode.errors import GCodeError
from coordinator.gcode.script_lines import script_lines
from coordinator.ipc.protocol.methods import ApiError, Caller, Kind, Method, Param, Scope, shown
from coordinator.modules.module_set import INTERRUPTING
from coordinator.modules.programs.gcode_macro import GCodeMacro
from coordinator.runtime.machine import Machine
from coordinator.service.core.feeder import FeederFull, QueuedWork
from coordinator.service.core.machine_service import MachineService, ServiceState
from coordinator.service.core.motion import Motion, MotionOver, texts
from coordinator.service.core.work import (
    EMERGENCY,
    LINES_BYTES_MAX,
    LINES_MAX,
    LinesWork,
    MoveWork,
    Rest,
    Work,
    WorkError,
    commands_in,
    has_emergency,
)
from coordinator.service.state.figures import axes, position_figures
from coordinator.streaming.move_source import ProgramOutput
from coordinator.support.shared_task import shared_task
from coordinator.support.values import Value
from nodes.support.errors import CanductorError

_DEFAULT_SPEED_MM_S: Final = 25.0
RESTARTS: Final = {"RESTART": False, "FIRMWARE_RESTART": True}
"""Commands that also a machine that stopped takes, and whether the nodes are reset."""
_DISTANCE_MAX_MM: Final = 1e6
_STEPS_KEPT_S: Final = 0.2
"""The positions that nodes reported are given again for so long: clients cannot load a bus by asking."""

_AXES: Final = tuple(
    Param(
        axis,
        Kind.FLOAT,
        f"{axis.upper()} of the machine",
        "mm",
        required=False,
        low=-_DISTANCE_MAX_MM,
        high=_DISTANCE_MAX_MM,
    )
    for axis in "xyze"
)
_SPEED: Final = Param(
    "speed_mm_s", Kind.FLOAT, "along the path", "mm/s", required=False, default=_DEFAULT_SPEED_MM_S, low=1e-3
)
_WAIT: Final = Param(
    "wait", Kind.BOOL, "answer when it is carried out, not when it is read", required=False, default=True
)
_TOLD: Final = (
    Param("replies", Kind.LIST, "what the lines asked for"),
    Param("notices", Kind.LIST, "what the user should know"),
)


HOMED_AXES: Final = "XYZ"
"""Letters that ``move.home`` takes."""
BY_LINE: Final = f"{EMERGENCY} of a client"
"""Who stops the machine by a line of g-code."""


@dataclass(frozen=True, slots=True)
class ScriptOutcome:
    """What lines of a client answered."""

    output: Sequence[ProgramOutput] = ()
    logged: bool = True
    """Whether the log has it already: not for what a running job lets through."""


async def run_script(service: MachineService, script: str, *, wait: bool) -> ScriptOutcome:
    """Have lines of g-code done; WAIT: until their moves are executed, too. Raises CanductorError.

    While a job prints they are done while_printing it, or between two of its lines.
    """
    await _take_turn(service)
    lines = _lines(script)
    names = _commands(lines)
    if EMERGENCY in names:  # written in a way that ``has_emergency`` does not look for, such as M0112
        service.emergency_stop(BY_LINE)
        return ScriptOutcome()
    if _restarted(service, names):
        return ScriptOutcome()
    work = LinesWork(lines, rest=Rest.STANDSTILL if wait else Rest.OPEN)
    motion = service.ready_motion()
    job = service.active_job
    interrupting = motion.feeder.vocabulary.interrupting.intersection(names)
    stay = bool(interrupting & INTERRUPTING)
    between = job is not None and _disturbs(motion, names)
    paused = service.programs.interrupted(stay=stay) if interrupting or between else contextlib.nullcontext()
    with paused:
        if job is None or job.gives_way:  # they come between two lines of it, and may move
            return ScriptOutcome((await _done(service, motion, work)).output)
        work.while_printing = True
        _check_while_printing(motion, names)
        return ScriptOutcome((await _done(service, motion, work, interjected=True)).output, logged=False)


async def _take_turn(service: MachineService) -> None:
    """Wait until a script may be read, which takes some 2 ms; raises ApiError if a stop came first."""
    before = service.state
    await service.turns.next()
    if service.state is not before and service.state is ServiceState.SHUTDOWN:  # a restart would undo it
        raise ApiError("stopped", f"the machine stopped: {service.cause}")


async def _run(service: MachineService, params: dict[str, Any]) -> Value:
    return _answer((await run_script(service, params["script"], wait=params["wait"])).output)


def _restarted(service: MachineService, names: list[str]) -> bool:
    """Restart a stopped machine, or one with a job, if NAMES ask for nothing else; return whether it was."""
    over = service.state in (ServiceState.SHUTDOWN, ServiceState.ERROR)
    if len(names) != 1 or names[0] not in RESTARTS or not (over or service.active_job is not None):
        return False
    if over:
        service.restart(firmware=RESTARTS[names[0]])
    else:
        service.restart_in_job(firmware=RESTARTS[names[0]])
    return True


def motion_methods(service: MachineService) -> Iterator[Method]:
    """Return them."""
    steps = _StepsOfNodes(service)

    def run(caller: Caller, params: dict[str, Any]) -> Awaitable[Value] | Value:
        if (who := _who_stops(caller, params)) is not None:
            service.emergency_stop(who)
            return _answer(())
        return _run(service, params)

    async def move_to(_caller: Caller, params: dict[str, Any]) -> Value:
        return await _move(service, params, relative=False)

    async def move_by(_caller: Caller, params: dict[str, Any]) -> Value:
        return await _move(service, params, relative=True)

    async def home(_caller: Caller, params: dict[str, Any]) -> Value:
        named = _axes_of(params["axes"])
        _idle_motion(service)
        work = LinesWork([f"G28 {' '.join(named)}"], name="move.home")
        return _answer((await _done(service, service.ready_motion(), work)).output)

    def macros(_caller: Caller, _params: dict[str, Any]) -> Value:
        modules = service.up_machine().modules
        help_ = modules.command_help
        names = sorted(macro.command for macro in modules.of(GCodeMacro))
        return {"macros": [{"name": name, "help": help_.get(name, "")} for name in names]}

    async def position(_caller: Caller, params: dict[str, Any]) -> Value:
        motion = service.ready_motion()
        await motion.begun.wait()
        output = position_figures(motion)
        output["offset"] = axes(motion.planned.state.gcode_offset)
        output["steppers"] = _stepper_figures(service.up_machine(), motion)
        if params["ask_nodes"]:
            output |= _node_figures(service.up_machine(), await steps.ask())
        return output

    yield Method(
        "gcode.run",
        Scope.OPERATE,
        "Run lines of g-code. While a job prints, those that neither move nor wait act at once: "
        + " ".join(sorted(WHILE_PRINTING))
        + ", and those of modules that say so; for others the job stands still between two of its lines, but"
        " never for " + ", ".join(sorted(NEVER_BETWEEN)) + ". While a job is paused any.",
        run,
        params=(Param("script", Kind.STR, "lines", high=LINES_BYTES_MAX), _WAIT),
        returns=_TOLD,
        stops=_who_stops,
        stop_words=(EMERGENCY, EMERGENCY.lower()),
    )
    yield Method(
        "gcode.macros",
        Scope.WATCH,
        "List the machine's macros ([gcode_macro]) by name.",
        macros,
        returns=(Param("macros", Kind.LIST, "maps of name and help"),),
    )
    for name, call, sentence in (
        ("move.to", move_to, "Move straight to a place in the machine's frame, whatever g-code modes hold."),
        ("move.by", move_by, "Move straight by a distance from where the last move ends."),
    ):
        yield Method(
            name,
            Scope.OPERATE,
            sentence,
            call,
            params=(*_AXES, _SPEED, _WAIT),
            returns=(Param("position", Kind.MAP, "end of the move in the machine's frame, mm"),),
        )
    yield Method(
        "move.home",
        Scope.OPERATE,
        "Home axes, as G28 does.",
        home,
        params=(Param("axes", Kind.STR, "letters; empty: all", required=False, default="", high=3),),
        returns=_TOLD,
    )
    yield Method(
        "position.get",
        Scope.WATCH,
        "Return the position in all frames, and of each stepper: steps since the machine started.",
        position,
        params=(
            Param(
                "ask_nodes", Kind.BOOL, "also ask the nodes what they count", required=False, default=False
            ),
        ),
        returns=(
            Param("commanded", Kind.MAP, "where it is now, machine's frame, mm"),
            Param("planned", Kind.MAP, "where the last move read ends, machine's frame, mm"),
            Param("gcode", Kind.MAP, "the same in the program's frame and units"),
            Param("origin", Kind.MAP, "the program's origin in the machine's frame, mm"),
            Param("offset", Kind.MAP, "the part of the origin that is SET_GCODE_OFFSET's, mm"),
            Param("steppers", Kind.MAP, "by name: steps sent, and mm of them"),
            Param("nodes_steps", Kind.MAP, "by stepper: steps as its node counts them; when asked for"),
            Param(
                "rails",
                Kind.MAP,
                "by stepper: where those steps have it, mm (rad where it turns); empty before homing",
                required=False,
            ),
            Param("kinematic", Kind.MAP, "where the head is, by those, mm", required=False),
        ),
    )


# ------------------------------------------------------------------------------------------------ doing


async def _done(
    service: MachineService, motion: Motion, work: Work, *, interjected: bool = False
) -> QueuedWork:
    """Have WORK done; raises ApiError where it was not, for whatever reason."""
    try:
        if interjected and isinstance(work, LinesWork):
            queued = await motion.do_interjection(work)
        else:
            queued = await motion.do(work)
    except FeederFull as error:
        raise ApiError("busy", str(error)) from None
    except MotionOver:
        raise ApiError("stopped", f"the machine stopped: {service.cause or 'it restarts'}") from None
    if isinstance(queued.error, GCodeError | WorkError):
        raise ApiError("bad_gcode" if isinstance(queued.error, GCodeError) else "bad_move", str(queued.error))
    if queued.error is not None:
        raise queued.error
    return queued


def _answer(output: Sequence[ProgramOutput]) -> Value:
    replies, notices = texts(output)
    return {"replies": list(replies), "notices": list(notices)}


def _lines(script: str) -> list[str]:
    lines = script_lines(script)
    if len(lines) > LINES_MAX:
        raise ApiError(
            "bad_params", f"gcode.run: {len(lines)} lines; at most {LINES_MAX}: print a file instead"
        )
    if not any(line.strip() for line in lines):
        raise ApiError("bad_params", "gcode.run: script has no line")
    return lines


def _axes_of(letters: str) -> str:
    """Return LETTERS of axes in capitals; raises ApiError for anything else: it would become g-code."""
    named = letters.upper() if letters.isascii() else "?"
    if len(set(named)) < len(named) or not set(named) <= set(HOMED_AXES):
        raise ApiError("bad_params", f"axes is {shown(letters)}; give letters of {HOMED_AXES}, each once")
    return named


def _who_stops(_caller: Caller, params: dict[str, Any]) -> str | None:
    return BY_LINE if has_emergency(params["script"]) else None


def _commands(lines: list[str]) -> list[str]:
    try:
        return commands_in(lines)
    except WorkError as error:
        raise ApiError("bad_gcode", str(error)) from None


NEVER_BETWEEN: Final = frozenset(
    (
        *("G28", "M84", "M18", "SAVE_CONFIG", "PID_CALIBRATE", "MPC_CALIBRATE", "Z_ENDSTOP_CALIBRATE"),
        *("MANUAL_PROBE", "FORCE_MOVE", "SET_KINEMATIC_POSITION", "STEPPER_BUZZ", "INIT_TMC"),
        *RESTARTS,
    )
)
"""Not while a job prints: they lose where the head is, or need the machine for long."""


def _disturbs(motion: Motion, names: list[str]) -> bool:
    """Return whether a job has to stand still for NAMES, between two of its lines."""
    disturbing = motion.feeder.vocabulary.disturbing
    if NEVER_BETWEEN.intersection(names):
        return False
    return any(name in disturbing or is_tool(name) for name in names)


def _check_while_printing(motion: Motion, names: list[str]) -> None:
    """Refuse commands that would disturb the job."""
    known = motion.feeder.vocabulary.commands
    for name in names:
        if name not in known and name not in HANDLERS and not is_tool(name):
            continue  # nobody knows it: that is said where it stands, not that the machine is busy
        if not (known[name].while_printing if name in known else name in WHILE_PRINTING):
            raise ApiError(
                "busy",
                f"{name} cannot run while a job prints; pause it with job.pause, or wait for its end",
            )


def _idle_motion(service: MachineService) -> Motion:
    motion = service.ready_motion()
    if service.active_job is not None and not service.active_job.gives_way:
        raise ApiError("busy", "a job prints; pause it with job.pause, or wait for its end")
    return motion


async def _move(service: MachineService, params: dict[str, Any], *, relative: bool) -> Value:
    motion = _idle_motion(service)
    wanted = {axis.upper(): params[axis] for axis in "xyze" if params[axis] is not None}
    if not wanted:
        raise ApiError("bad_params", "the move names no axis; give x, y, z or e")
    speed, most = params["speed_mm_s"], service.up_machine().description.limits.max_velocity
    if speed > most:
        raise ApiError("bad_params", f"speed_mm_s is {speed:g}; this machine moves at most at {most:g} mm/s")
    rest = Rest.STANDSTILL if params["wait"] else Rest.OPEN
    work = MoveWork(wanted, speed, relative, rest=rest)
    await _done(service, motion, work)
    return {"position": axes((work.target[0], work.target[1], work.target[2], work.target[3]))}


# --------------------------------------------------------------------------------------------- positions


def _stepper_figures(machine: Machine, motion: Motion) -> Value:
    steppers = machine.description.steppers
    return {
        stepper.name: {"steps_sent": steps, "sent_mm": round(steps * stepper.step_distance, 6)}
        for stepper, steps in zip(steppers, motion.planned.steps_sent, strict=False)
    }


def _node_figures(machine: Machine, steps: dict[str, int]) -> dict[str, Value]:
    """Return what follows from the STEPS that the nodes count."""
    places = machine.stepper_positions.positions(steps)
    head = machine.stepper_positions.head(places)
    return {
        "nodes_steps": dict(steps),
        "rails": {name: round(place, 6) for name, place in places.items()},
        "kinematic": None
        if head is None
        else {axis: round(at, 6) for axis, at in zip("xyz", head, strict=True)},
    }


class _StepsOfNodes:
    """Asks the nodes for their steppers' positions: one question at a time, however many clients ask."""

    def __init__(self, service: MachineService) -> None:
        self._service = service
        self._asking: asyncio.Task[dict[str, int]] | None = None
        self._answer: dict[str, int] = {}
        self._answered_s = float("-inf")

    async def ask(self) -> dict[str, int]:
        """Return steps by stepper; raises CanductorError."""
        loop = asyncio.get_running_loop()
        if loop.time() - self._answered_s < _STEPS_KEPT_S:
            return self._answer
        if self._asking is None or self._asking.done():
            self._asking = shared_task(self._ask())
        return await asyncio.shield(self._asking)

    async def _ask(self) -> dict[str, int]:
        try:
            found = dict(await self._service.up_machine().query_stepper_counts())
        except ApiError:
            raise
        except CanductorError as error:
            raise ApiError("failed", str(error)) from None
        self._answer, self._answered_s = found, asyncio.get_running_loop().time()
        return found

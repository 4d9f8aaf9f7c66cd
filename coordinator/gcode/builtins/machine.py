"""Commands that change the machine while a program runs: pressure advance, shapers, carriages, extruders.

What changes the moves themselves (ADVANCE, limits) acts on the planner from the next line on. What changes
the steps made of them (shapers, windows, who follows whom) comes to a standstill first and goes to step
generation as an event with its print time.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial

from coordinator.gcode.builtins.state import check_room
from coordinator.gcode.commands import Phases, ProgramAction, ProgramContext, Reading
from coordinator.gcode.events import (
    PositionSet,
    Reply,
    ShaperChange,
    SmoothTimeChange,
    SurfaceChange,
    WeightsChange,
)
from coordinator.gcode.machine_state import DEFAULT_STATE, SHAPER_AXES, Extruder, MachineState, Shaper
from coordinator.gcode.parameters import bounded, flag, needed
from coordinator.gcode.parser import Command, WordError, number, quoted
from coordinator.kinematics.dual_carriage import CarriageMode, CarriageState, DualCarriage
from coordinator.motion.planner.planner import FeedStatus
from coordinator.motion.steps.shapers import check_reach, split_kind
from coordinator.motion.steps.steps import SMOOTH_MAX_S, SMOOTH_MIN_S
from coordinator.motion.steps.surface import Surface

MAX_FREQUENCY_HZ = 1000.0
MAX_ADVANCE_S = 10.0
MIN_ROTATION_MM = 0.1
MAX_ROTATION_MM = 10_000.0
NO_TOOLS_FROM = 100
"""Numbers of tools from here on stand for none in what slicers write: T255, T1000."""
_TOOL = re.compile(r"T\d{1,9}")


def come_to_standstill(job: ProgramContext, settle_s: float = 0.0) -> bool:
    """Plan to a standstill of at least SETTLE_S, after which no step is left; False: call again."""
    if not job.planner.flush():
        return False
    job.planner.dwell(max(settle_s, job.machine.settle_s()))
    return True


def follow_surface(job: ProgramContext, surface: Surface | None) -> bool:
    """Let Z follow SURFACE from here on; no motor moves. False: call again."""
    if not come_to_standstill(job, job.machine.settle_s()):
        return False
    planner = job.planner
    motors = job.machine.motor_position(planner.toolhead_position)
    job.machine.surface = surface
    position = job.machine.planned_position(motors)
    planner.set_position(position)
    at_s = planner.print_time_end_s
    job.emit(SurfaceChange(job.line, surface, at_s))
    job.emit(PositionSet(job.line, "", position, at_s))
    return True


def begin(job: ProgramContext) -> None:
    """Set JOB's planner up for the state of its machine."""
    if job.machine.active is not None:
        _use_extruder(job, job.machine.active)
    _keep_apart(job)


def home_carriages(job: ProgramContext, axes: str, second_mm: float | None = None) -> None:
    """After homing, the first carriage is the head and the second is parked; the machine is at rest.

    SECOND_MM: where the second one stands, if that is not exactly its home.
    """
    machine = job.machine
    if (
        machine.carriages is None
        or machine.carriage_state is None
        or "XYZ"[machine.carriages.axis] not in axes
    ):
        return
    changed = machine.carriage_state.modes != machine.carriages.home.modes
    home = machine.carriages.home
    second_mm = home.positions[1] if second_mm is None else second_mm
    machine.carriage_state = replace(home, positions=(home.positions[0], second_mm))
    _keep_apart(job)
    if changed:
        weights = machine.carriages.weights(machine.carriage_state)
        job.emit(WeightsChange(job.line, weights, job.planner.print_time_end_s))


# ---- Parameters ------------------------------------------------------------------------------------------


def _extruder(job: ProgramContext, command: Command, name: str | None) -> Extruder:
    """Return the extruder NAME, without a name the active one."""
    extruders = job.machine.extruders
    chosen = job.machine.active if name is None else extruders.get(name)
    if chosen is None:
        what = f"names the extruder {quoted(name)}" if name is not None else "needs an extruder"
        has = f"has {', '.join(extruders)}" if extruders else "has no extruder"
        raise WordError(f"{command.name} {what}; this machine {has}")
    return chosen


# ---- Extruders -------------------------------------------------------------------------------------------


def set_pressure_advance(job: ProgramContext, command: Command) -> bool:
    """ADVANCE holds for the moves to come; SMOOTH_TIME, where it changes, from a standstill on.

    So does the first ADVANCE above 0, which needs the window.
    """
    values = command.only_parameters(("ADVANCE", "SMOOTH_TIME", "EXTRUDER"))
    name = values.get("EXTRUDER")
    filament = job.machine.filament
    if name is not None and name not in job.machine.extruders and filament is not None:
        # One motion has one advance: a stepper that follows an extruder has that of the extruder.
        name = filament.followed.get(name, name)
        if not name:
            job.notice(f"{command.name} of {values['EXTRUDER']}", "it follows no extruder: without effect")
            return True
    extruder = _extruder(job, command, name)
    advance = bounded(command, values, "ADVANCE", None, low=0, high=MAX_ADVANCE_S)
    smooth = bounded(command, values, "SMOOTH_TIME", None, low=0, high=SMOOTH_MAX_S)
    if smooth is not None and 0 < smooth < SMOOTH_MIN_S:
        raise WordError(
            f"SMOOTH_TIME of {command.name} is {smooth:g}; give 0, or {SMOOTH_MIN_S:g} s and more"
        )
    smooth_s = extruder.smooth_s if smooth is None else smooth
    window = smooth_s if advance or extruder.window_s else 0.0
    if window != extruder.window_s:
        if job.while_printing:
            raise WordError(
                f"{command.name} needs a standstill for the first ADVANCE, and for another SMOOTH_TIME; pause"
                " the job first"
            )
        if not come_to_standstill(job, window):
            return False
        extruder.window_s = window
        job.emit(SmoothTimeChange(job.line, extruder.name, window, job.planner.print_time_end_s))
    extruder.smooth_s = smooth_s
    if advance is not None:
        extruder.pressure_advance_s = advance
        if extruder is job.machine.active:
            job.planner.pressure_advance = advance
    if advance is None and smooth is None:
        text = f"{extruder.name}: ADVANCE={extruder.pressure_advance_s:g} SMOOTH_TIME={extruder.smooth_s:g}"
        job.emit(Reply(job.line, text))
    return True


def activate_extruder(job: ProgramContext, command: Command) -> bool:
    """ACTIVATE_EXTRUDER EXTRUDER=name: from now on E moves this one, and reads where this one stands."""
    values = command.only_parameters(("EXTRUDER",))
    return _activate(job, _extruder(job, command, needed(command, values, "EXTRUDER")))


def is_tool(name: str) -> bool:
    """Whether NAME is T0, T1 and so on."""
    return _TOOL.fullmatch(name) is not None


def select_tool(job: ProgramContext, command: Command) -> bool:
    """T0, T1, ...: the extruders in their order."""
    extruders = job.machine.extruders
    if not extruders and command.name == "T0":
        return True
    number_of_tool = int(command.name[1:])
    tool = job.machine.tool(number_of_tool)
    if tool is None and number_of_tool >= NO_TOOLS_FROM:
        job.notice(command.name, "means no tool, as slicers write it, and is ignored")
        return True
    if tool is None:
        last = max(len(extruders) - 1, 0)
        has = f"T0 to T{last}" if last else "only T0"
        raise WordError(f"{command.name} selects a tool that does not exist; this machine has {has}")
    return _activate(job, tool)


def _activate(job: ProgramContext, extruder: Extruder) -> bool:
    motion = job.machine.filament
    if motion is None or motion.active == extruder.name:
        return True
    if not come_to_standstill(job):
        return False
    _change_places(job, job.machine.active, extruder)
    job.machine.filament = motion.activate(extruder.name)
    _use_extruder(job, extruder)
    _follow(job)
    return True


def _change_places(job: ProgramContext, before: Extruder | None, after: Extruder) -> None:
    """Make E read the last position of AFTER; the machine's E axis continues from that of BEFORE."""
    planner = job.planner
    if before is not None:
        before.place_mm = planner.gcode_position[3] * planner.unit_mm
    planner.set_gcode_position({"E": after.place_mm / planner.unit_mm})


def _use_extruder(job: ProgramContext, extruder: Extruder) -> None:
    job.planner.set_extruder_limits(extruder.limits)
    job.planner.pressure_advance = extruder.pressure_advance_s


def _follow(job: ProgramContext) -> None:
    if job.machine.filament is not None:
        job.emit(WeightsChange(job.line, job.machine.filament.weights(), job.planner.print_time_end_s))


def sync_extruder_motion(job: ProgramContext, command: Command) -> bool:
    """EXTRUDER: a filament stepper; MOTION_QUEUE: the extruder it moves with, empty for none."""
    values = command.only_parameters(("EXTRUDER", "MOTION_QUEUE"))
    stepper, queue = (needed(command, values, key) for key in ("EXTRUDER", "MOTION_QUEUE"))
    motion = job.machine.filament
    if motion is None:
        raise WordError("SYNC_EXTRUDER_MOTION needs an extruder; this machine has none")
    after = motion.sync(stepper, queue)
    if after == motion:
        return True
    if not come_to_standstill(job):
        return False
    job.machine.filament = after
    _follow(job)
    return True


def set_extruder_rotation_distance(job: ProgramContext, command: Command) -> bool:
    """EXTRUDER: a filament stepper; DISTANCE: its way per turn from a standstill on, below 0: reversed."""
    values = command.only_parameters(("EXTRUDER", "DISTANCE"))
    stepper = needed(command, values, "EXTRUDER")
    motion = job.machine.filament
    if motion is None:
        raise WordError(f"{command.name} needs an extruder; this machine has none")
    now_mm = motion.rotation_distance_mm(stepper)
    if "DISTANCE" not in values:
        job.emit(Reply(job.line, f"{stepper}: rotation_distance {now_mm:.6f} mm"))
        return True
    distance_mm = number(command.name, values, "DISTANCE")
    if not MIN_ROTATION_MM <= abs(distance_mm) <= MAX_ROTATION_MM:
        raise WordError(
            f"DISTANCE of {command.name} is {distance_mm:g}; {MIN_ROTATION_MM:g} to {MAX_ROTATION_MM:g} mm"
            " are possible, with a minus to turn the other way round"
        )
    if distance_mm != now_mm:
        if not come_to_standstill(job):
            return False
        job.machine.filament = motion.set_rotation_distance(stepper, distance_mm)
        _follow(job)
    job.emit(Reply(job.line, f"{stepper}: rotation_distance {distance_mm:.6f} mm"))
    return True


# ---- Shapers ---------------------------------------------------------------------------------------------


def set_input_shaper(job: ProgramContext, command: Command) -> bool:
    """SHAPER_TYPE of all axes; SHAPER_TYPE_X, SHAPER_FREQ_X (0: not shaped), DAMPING_RATIO_X of one."""
    words = ("SHAPER_TYPE", "SHAPER_FREQ", "DAMPING_RATIO")
    values = command.only_parameters(("SHAPER_TYPE", *(f"{w}_{axis}" for w in words for axis in SHAPER_AXES)))
    before = {axis: job.machine.shapers.get(axis, Shaper()) for axis in SHAPER_AXES}
    after = {axis: _shaper(command, values, axis, shaper) for axis, shaper in before.items()}
    if not values:
        job.emit(Reply(job.line, " ".join(_shown(axis, shaper) for axis, shaper in after.items())))
        return True
    # An axis that is not shaped stays so whatever its kind would be.
    changed = [a for a in SHAPER_AXES if after[a] != before[a] and (before[a].width_s or after[a].width_s)]
    if changed and not come_to_standstill(job, job.machine.settle_s(after)):
        return False
    job.machine.shapers = after
    for axis in changed:
        new = after[axis]
        change = (new.kind, new.frequency_hz, new.damping_ratio, job.planner.print_time_end_s)
        job.emit(ShaperChange(job.line, axis, *change))
    return True


def _shaper(command: Command, values: Mapping[str, str], axis: str, before: Shaper) -> Shaper:
    kind = values.get(f"SHAPER_TYPE_{axis}", values.get("SHAPER_TYPE", before.kind)).lower()
    try:
        split_kind(kind)
    except ValueError as problem:
        raise WordError(f"{command.name} names the shaper {quoted(kind)}; {problem}") from None
    frequency = bounded(command, values, f"SHAPER_FREQ_{axis}", None, low=0, high=MAX_FREQUENCY_HZ)
    damping = bounded(command, values, f"DAMPING_RATIO_{axis}", None, low=0, high=0.999)
    if frequency is not None and 0 < frequency < 1:
        raise WordError(f"SHAPER_FREQ_{axis} of {command.name} is {frequency:g}; give 0 or 1 Hz and more")
    after = Shaper(
        kind,
        before.frequency_hz if frequency is None else frequency,
        before.damping_ratio if damping is None else damping,
    )
    if after.frequency_hz:
        try:
            check_reach(after.kind, after.frequency_hz, after.damping_ratio)
        except ValueError as problem:
            raise WordError(f"{command.name}: {problem}") from None
    return after


def _shown(axis: str, shaper: Shaper) -> str:
    return (
        f"SHAPER_TYPE_{axis}={shaper.kind} SHAPER_FREQ_{axis}={shaper.frequency_hz:g} "
        f"DAMPING_RATIO_{axis}={shaper.damping_ratio:g}"
    )


# ---- Carriages -------------------------------------------------------------------------------------------


def set_dual_carriage(job: ProgramContext, command: Command) -> bool:
    """CARRIAGE 0 or 1; MODE is PRIMARY where it is not given."""
    carriages, state = _dual(job, command)
    values = command.only_parameters(("CARRIAGE", "MODE"))
    which = needed(command, values, "CARRIAGE")
    if which not in {"0", "1"}:
        raise WordError(f"CARRIAGE of {command.name} is {quoted(which)}; give 0 or 1")
    word = values.get("MODE", CarriageMode.PRIMARY.value).upper()
    modes = [mode.value for mode in CarriageMode]
    if word not in modes:
        raise WordError(f"MODE of {command.name} is {quoted(word)}; there are {' '.join(modes)}")
    if "XYZ"[carriages.axis] not in job.planner.homed:
        raise WordError(f"{command.name} comes before {'XYZ'[carriages.axis]} is homed; home with G28 first")
    position = job.planner.toolhead_position[carriages.axis]
    after = carriages.set_mode(state, position, int(which), CarriageMode(word))
    if not come_to_standstill(job):
        return False
    _take_carriages(job, carriages, after)
    return True


def save_dual_carriage_state(job: ProgramContext, command: Command) -> bool:
    """NAME: keep what both carriages do."""
    carriages, state = _dual(job, command)
    name = command.only_parameters(("NAME",)).get("NAME", DEFAULT_STATE)
    check_room(job.machine.saved_carriages, name)
    position = job.planner.toolhead_position[carriages.axis]
    job.machine.saved_carriages[name] = replace(state, positions=state.at(position))
    return True


def restore_dual_carriage_state(job: ProgramContext, command: Command) -> bool:
    """NAME: let both carriages do what they did then; without MOVE=0, where they were.

    They go there one after the other, along their own axis only, at MOVE_SPEED (mm/s), else at the speed at
    which the axis is homed.
    """
    carriages, _ = _dual(job, command)
    values = command.only_parameters(("NAME", "MOVE", "MOVE_SPEED"))
    name = values.get("NAME", DEFAULT_STATE)
    saved = job.machine.saved_carriages.get(name)
    if saved is None:
        raise WordError(f"{command.name} names the state {quoted(name)}, which is not saved")
    moves = "MOVE" not in values or flag(command, values, "MOVE")
    speed_mm_s = bounded(command, values, "MOVE_SPEED", carriages.home_speed_mm_s, low=1e-3, high=1e6)
    if "XYZ"[carriages.axis] not in job.planner.homed:
        raise WordError(f"{command.name} comes before {'XYZ'[carriages.axis]} is homed; home with G28 first")
    return job.follow(command, Phases(lambda job: _restore_carriages(job, saved, speed_mm_s if moves else 0)))


def _restore_carriages(job: ProgramContext, saved: CarriageState, speed_mm_s: float) -> Iterator[Reading]:
    """Move each carriage to its place in SAVED at SPEED_MM_S (0: none is moved), then restore the modes."""
    carriages, state = job.machine.carriages, job.machine.carriage_state
    assert carriages is not None
    assert state is not None
    if speed_mm_s:
        here = state.at(job.planner.toolhead_position[carriages.axis])
        for number_ in carriages.order_of_moves(here, saved.positions):
            yield ProgramAction(partial(_set_carriage, carriage=number_, mode=CarriageMode.PRIMARY))
            yield ProgramAction(
                partial(_move_carriage, target_mm=saved.positions[number_], speed_mm_s=speed_mm_s)
            )
    yield ProgramAction(partial(_set_carriage, carriage=saved.primary, mode=CarriageMode.PRIMARY))
    other = saved.modes[1 - saved.primary]
    if other in {CarriageMode.COPY, CarriageMode.MIRROR}:
        yield ProgramAction(partial(_set_carriage, carriage=1 - saved.primary, mode=other))


def _set_carriage(job: ProgramContext, carriage: int, mode: CarriageMode) -> bool:
    carriages, state = job.machine.carriages, job.machine.carriage_state
    assert carriages is not None
    assert state is not None
    position = job.planner.toolhead_position[carriages.axis]
    after = carriages.set_mode(state, position, carriage, mode)
    if after.modes == state.modes:
        return True
    if not come_to_standstill(job):
        return False
    _take_carriages(job, carriages, after)
    return True


def _move_carriage(job: ProgramContext, target_mm: float, speed_mm_s: float) -> bool:
    carriages = job.machine.carriages
    assert carriages is not None
    target = list(job.planner.toolhead_position)
    assert job.machine.carriage_state is not None
    low, high = carriages.limits(job.machine.carriage_state)
    target[carriages.axis] = min(max(target_mm, low), high)  # but for rounding it is within
    status = job.planner.move_to(target, min(speed_mm_s, job.planner.max_velocity))
    if status is FeedStatus.LIMIT:
        raise WordError(str(job.planner.fault))
    return status is not FeedStatus.FULL


def _dual(job: ProgramContext, command: Command) -> tuple[DualCarriage, CarriageState]:
    carriages, state = job.machine.carriages, job.machine.carriage_state
    if carriages is None or state is None:
        raise WordError(f"{command.name} needs a second carriage; this machine has no [dual_carriage]")
    return carriages, state


def _take_carriages(job: ProgramContext, carriages: DualCarriage, after: CarriageState) -> None:
    planner, axis = job.planner, carriages.axis
    job.machine.carriage_state = after
    job.emit(WeightsChange(job.line, carriages.weights(after), planner.print_time_end_s))
    position = planner.toolhead_position
    if after.position != position[axis]:  # the other carriage is the head now
        x, y, z, e = (after.position if i == axis else value for i, value in enumerate(position))
        planner.set_position((x, y, z, e))
        job.emit(PositionSet(job.line, "XYZ"[axis], (x, y, z, e), planner.print_time_end_s))
    _keep_apart(job)


def _keep_apart(job: ProgramContext) -> None:
    machine: MachineState = job.machine
    if machine.carriages is not None and machine.carriage_state is not None:
        job.planner.set_range(machine.carriages.axis, *machine.carriages.limits(machine.carriage_state))


HANDLERS = {
    "ACTIVATE_EXTRUDER": activate_extruder,
    "RESTORE_DUAL_CARRIAGE_STATE": restore_dual_carriage_state,
    "SAVE_DUAL_CARRIAGE_STATE": save_dual_carriage_state,
    "SET_DUAL_CARRIAGE": set_dual_carriage,
    "SET_EXTRUDER_ROTATION_DISTANCE": set_extruder_rotation_distance,
    "SET_INPUT_SHAPER": set_input_shaper,
    "SET_PRESSURE_ADVANCE": set_pressure_advance,
    "SYNC_EXTRUDER_MOTION": sync_extruder_motion,
}

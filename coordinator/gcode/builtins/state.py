"""Where a program's numbers point: offsets of the origin, states that are saved and restored, all frames."""

from collections.abc import Mapping
from typing import Final

from coordinator.gcode.commands import ProgramContext
from coordinator.gcode.events import Reply
from coordinator.gcode.machine_state import DEFAULT_STATE, SavedState
from coordinator.gcode.parameters import flag
from coordinator.gcode.parser import Command, WordError, number, quoted
from coordinator.gcode.status import MotionStatus, frames
from coordinator.motion.planner.planner import AXIS_LETTERS, FeedStatus, Planner

MOVE_SPEED_MM_S: Final = 50.0
"""Of the moves that these commands make, unless they say otherwise."""
SAVED_MAX: Final = 100
"""States of one kind that may be kept."""


def _speed(job: ProgramContext, command: Command, values: Mapping[str, str], otherwise_mm_s: float) -> float:
    if "MOVE_SPEED" not in values:
        return min(otherwise_mm_s, job.planner.max_velocity)
    speed = number(command.name, values, "MOVE_SPEED")
    if not 0 < speed <= 1e6:
        raise WordError(f"MOVE_SPEED of {command.name} is {speed:g}; it must be above 0 mm/s")
    return speed


def go(job: ProgramContext, target: list[float], speed_mm_s: float) -> bool:
    """Move to TARGET; False: the planner has to be emptied first."""
    status = job.planner.move_to(target, speed_mm_s)
    if status is FeedStatus.LIMIT:
        raise WordError(str(job.planner.fault))
    return status is not FeedStatus.FULL


# ---- Offsets ---------------------------------------------------------------------------------------------


def set_gcode_offset(job: ProgramContext, command: Command) -> bool:
    """X Y Z E: the offset; X_ADJUST ...: by how much it changes; MOVE=1: go along at once.

    While a job prints, MOVE adds the change to the job's next move: the job does not stop for it.
    """
    adjust = [f"{axis}_ADJUST" for axis in AXIS_LETTERS]
    values = command.only_parameters((*AXIS_LETTERS, *adjust, "MOVE", "MOVE_SPEED"))
    planner = job.planner
    before = dict(zip(AXIS_LETTERS, planner.gcode_offset, strict=True))
    after: dict[str, float] = {}
    for axis in AXIS_LETTERS:
        if axis in values:
            after[axis] = number(command.name, values, axis)
        elif f"{axis}_ADJUST" in values:
            after[axis] = before[axis] + number(command.name, values, f"{axis}_ADJUST")
    change = {axis: value - before[axis] for axis, value in after.items()}
    if flag(command, values, "MOVE") and any(change.values()):
        if job.while_printing:
            _check_reach(job, change)
            for axis, distance in change.items():
                planner.shift_program(axis, distance)
        else:
            there = planner.toolhead_position
            target = [at + change.get(axis, 0.0) for axis, at in zip(AXIS_LETTERS, there, strict=True)]
            if not go(job, target, _speed(job, command, values, MOVE_SPEED_MM_S)):
                return False
    planner.set_gcode_offset(after)
    return True


def _check_reach(job: ProgramContext, change: Mapping[str, float]) -> None:
    """Refuse an offset that would take the next move out of the machine; the job continues without it."""
    limits = job.planner.limits
    for axis, at, low, high in zip(
        "XYZ", job.planner.toolhead_position, limits.position_min, limits.position_max, strict=False
    ):
        target = at + change.get(axis, 0.0)
        if change.get(axis) and not low <= target <= high:
            raise WordError(
                f"the offset would take {axis} to {target:.6g} mm, outside {low:g} to {high:g} mm; choose"
                " a smaller one"
            )


# ---- States ----------------------------------------------------------------------------------------------


def save_gcode_state(job: ProgramContext, command: Command) -> bool:
    """NAME: save modes, speed, factors, origin, offset and position."""
    name = command.only_parameters(("NAME",)).get("NAME", DEFAULT_STATE)
    save_state(job, name)
    return True


def save_state(job: ProgramContext, name: str) -> None:
    """Keep what holds for the lines to come under NAME; raises WordError."""
    check_room(job.machine.saved, name)
    job.machine.saved[name] = present_state(job.planner)


def check_room(saved: Mapping[str, object], name: str) -> None:
    """Raise WordError where SAVED has no room for another state called NAME."""
    if name not in saved and len(saved) >= SAVED_MAX:
        raise WordError(f"{SAVED_MAX} states are saved already; use one of their names again")


def present_state(planner: Planner) -> SavedState:
    """Return what holds for the lines to come."""
    return SavedState(
        position=planner.toolhead_position,
        base=planner.gcode_base,
        offset=planner.gcode_offset,
        unit_mm=planner.unit_mm,
        relative=planner.relative,
        relative_extrusion=planner.relative_extrusion,
        speed_mm_s=planner.speed_mm_s,
        speed_factor=planner.speed_factor,
        extrude_factor=planner.extrude_factor,
        homed=planner.homed,
    )


def restore_gcode_state(job: ProgramContext, command: Command) -> bool:
    """NAME: restore all that; MOVE=1: also move back to where X Y Z were."""
    values = command.only_parameters(("NAME", "MOVE", "MOVE_SPEED"))
    name = values.get("NAME", DEFAULT_STATE)
    saved = job.machine.saved.get(name)
    if saved is None:
        has = f"there is {', '.join(job.machine.saved)}" if job.machine.saved else "none is saved"
        raise WordError(f"{command.name} names the state {quoted(name)}, which is not saved; {has}")
    speed = _speed(job, command, values, saved.speed_mm_s) if flag(command, values, "MOVE") else None
    return restore_state(job, saved, speed)


def restore_state(job: ProgramContext, saved: SavedState, move_mm_s: float | None) -> bool:
    """Restore SAVED; MOVE_MM_S: also move back at this speed.

    E reads as it did, wherever the filament is meanwhile. False: the planner has to be emptied first.
    """
    planner = job.planner
    if move_mm_s is not None:
        target = [*saved.position[:3], planner.toolhead_position[3]]
        if not go(job, target, move_mm_s):
            return False
    planner.extrude_factor = saved.extrude_factor
    planner.unit_mm, planner.relative = saved.unit_mm, saved.relative
    planner.relative_extrusion, planner.speed_mm_s = saved.relative_extrusion, saved.speed_mm_s
    planner.speed_factor = saved.speed_factor
    moved_e = planner.toolhead_position[3] - saved.position[3]
    x, y, z, e = saved.base
    planner.restore_origin((x, y, z, e + moved_e), saved.offset)
    return True


def come_back(
    planner: Planner, saved: SavedState, speed_mm_s: float, lift_mm: float = 0.0, *, left_out: bool = False
) -> bool:
    """Move back to SAVED and restore the job's frame; offsets changed meanwhile and factors stay.

    X and Y are approached at the greater of both heights, LIFT_MM above the one where the job continues.
    LEFT_OUT: the head stays above it, and moves are left out from there on. False: the planner has to be
    emptied first. Raises WordError.
    """
    offsets = zip(planner.gcode_offset, saved.offset, strict=True)
    change = [now - before for now, before in offsets]
    x, y, z, _ = (at + shift for at, shift in zip(saved.position, change, strict=True))
    here = planner.toolhead_position
    high = max(here[2], min(z + lift_mm, max(z, planner.limits.position_max[2])))
    if here[:3] == (x, y, z):
        high = z
    low = high if left_out else z
    for target in ((*here[:2], high, here[3]), (x, y, high, here[3]), (x, y, low, here[3])):
        if target == planner.toolhead_position:
            continue
        status = planner.move_to(target, min(speed_mm_s, planner.limits.max_velocity))
        if status is FeedStatus.LIMIT:
            raise WordError(str(planner.fault))
        if status is FeedStatus.FULL:
            return False
    planner.unit_mm, planner.relative = saved.unit_mm, saved.relative
    planner.relative_extrusion, planner.speed_mm_s = saved.relative_extrusion, saved.speed_mm_s
    base = [at + shift for at, shift in zip(saved.base, change, strict=True)]
    base[3] += here[3] - saved.position[3]
    planner.restore_origin((base[0], base[1], base[2], base[3]), planner.gcode_offset)
    if left_out:
        planner.leave_out_from((x, y, z, here[3]))
    return True


# ---- Positions -------------------------------------------------------------------------------------------


def get_position(job: ProgramContext, _command: Command) -> bool:
    """GET_POSITION where nothing is connected: the frames of the program."""
    for text in frames(MotionStatus.of(job.planner, job.machine).figures()):
        job.emit(Reply(job.line, text))
    return True


HANDLERS = {
    "GET_POSITION": get_position,
    "RESTORE_GCODE_STATE": restore_gcode_state,
    "SAVE_GCODE_STATE": save_gcode_state,
    "SET_GCODE_OFFSET": set_gcode_offset,
}

"""TUNING_TOWER: a command of which one value changes with the height of what is printed."""

from dataclasses import replace
from typing import Final

from coordinator.gcode.commands import ProgramContext
from coordinator.gcode.events import Reply
from coordinator.gcode.parameters import bounded, needed, value
from coordinator.gcode.parser import Command, WordError, parse, quoted
from coordinator.gcode.tuning_tower import TuningTower

NAME: Final = "TUNING_TOWER"
_MOST: Final = 1e9
_HIGHEST_MM: Final = 1e5
_PARAMETERS: Final = ("COMMAND", "PARAMETER", "START", "SKIP", "FACTOR", "BAND", "STEP_DELTA", "STEP_HEIGHT")


def begin_tower(job: ProgramContext, command: Command) -> bool:
    """Begin a tower; it ends with one that is begun, or when another print begins below."""
    given = command.only_parameters(_PARAMETERS)
    text = needed(command, given, "COMMAND").strip()
    parameter = needed(command, given, "PARAMETER").strip().upper()
    tuned = parse(text.encode(errors="replace"))
    if tuned is None or not parameter.isidentifier():
        raise WordError(f"{NAME} needs COMMAND= and PARAMETER=, such as SET_PRESSURE_ADVANCE and ADVANCE")
    if not job.knows(tuned.name):
        raise WordError(f"{NAME} is for {quoted(tuned.name)}, which is no command of this machine")
    step = value(command, given, "STEP_DELTA", 0.0)
    factor = value(command, given, "FACTOR", 0.0)
    band_mm = bounded(command, given, "BAND", 0.0, low=0, high=_HIGHEST_MM)
    height_mm = bounded(command, given, "STEP_HEIGHT", 0.0, low=0, high=_HIGHEST_MM)
    if ("STEP_DELTA" in given) != bool(height_mm):
        raise WordError(f"{NAME} needs both STEP_DELTA and STEP_HEIGHT above 0, or none of them")
    if height_mm and (factor or band_mm):
        raise WordError(f"{NAME} takes FACTOR and BAND, or STEP_DELTA and STEP_HEIGHT, not all; leave two")
    start = bounded(command, given, "START", 0.0, low=-_MOST, high=_MOST)
    skip_mm = bounded(command, given, "SKIP", 0.0, low=0, high=_HIGHEST_MM)
    tower = TuningTower(
        text, parameter, start, factor, band_mm, step, height_mm, skip_mm, written=command.text
    )
    job.machine.tower = tower
    watch(job)
    job.emit(Reply(job.line, f"{NAME} begins: {tower.line(tower.value_at(0.0))}"))
    return True


def watch(job: ProgramContext) -> None:
    """Let JOB's planner watch for the heights at which the tower has another value."""
    tower = job.machine.tower
    job.planner.watch_height(None if tower is None else tower.z_mm)


def reach(job: ProgramContext, z_mm: float) -> str:
    """Return the line that comes before a move that prints at Z_MM; empty: there is none."""
    tower = job.machine.tower
    if tower is None or tower.ends_at(z_mm):
        job.machine.tower = None
        if tower is not None:
            job.emit(Reply(job.line, f"{NAME} ends: another print begins"))
        watch(job)
        return ""
    found = tower.value_at(z_mm)
    line = "" if found == tower.value else tower.line(found)
    job.machine.tower = replace(tower, z_mm=z_mm, value=found)
    watch(job)
    return line


HANDLERS: Final = {NAME: begin_tower}

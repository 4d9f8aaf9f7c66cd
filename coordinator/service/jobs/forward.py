"""Where an interrupted program goes on: it is read again up to a line, and nothing is done meanwhile."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from coordinator.config.model import MachineDescription
from coordinator.gcode.builtins import tuning
from coordinator.gcode.builtins.state import present_state
from coordinator.gcode.events import Emergency, End
from coordinator.gcode.interpreter import Job
from coordinator.gcode.machine_state import SavedState
from coordinator.gcode.parser import command_line
from coordinator.gcode.program import Program
from coordinator.modules.compensation.skew_correction import Skews
from coordinator.modules.module_set import build_modules
from coordinator.modules.programs.exclude_object import ExcludeObject
from coordinator.modules.programs.gcode_macro import GCodeMacro
from coordinator.motion.history._history import ffi, lib
from coordinator.motion.planner.planner import Planner
from coordinator.runtime.machine import Modules
from coordinator.streaming.program_machine import machine_state
from nodes.support.errors import CanductorError

_DYNAMICS: Final = (
    "accel",
    "travel_accel",
    "axis_limits",
    "max_velocity",
    "square_corner_velocity",
    "minimum_cruise_ratio",
    "plane",
)


@dataclass(frozen=True)
class Reached:
    """What holds where a program goes on."""

    state: SavedState
    dynamics: Mapping[str, Any]
    """Of the planner."""
    variables: Mapping[str, Mapping[str, Any]]
    """Of macros, by section."""
    lines: tuple[str, ...]
    """That bring the extruder, and the correction of skew, into the state that they had."""
    part_mm: float = 0.0
    """Up to which height something was printed, in the machine's frame."""
    objects: ExcludeObject | None = None
    """The program's objects as far as they were defined; None: there is no [exclude_object]."""


def read_forward(description: "MachineDescription", program: Program, end_bytes: int) -> Reached:
    """Read PROGRAM up to END_BYTES without doing anything; raises CanductorError. It may take a while."""
    modules = build_modules(description)
    planner = Planner(description.limits)
    machine = machine_state(description, modules.vocabulary)
    program.end_bytes = end_bytes
    objects = next(modules.of(ExcludeObject), None)
    if objects is not None:
        objects.only_looks = True
    part_mm = 0.0
    job = Job(program, planner, description.homed_position, machine, modules.vocabulary)
    while not isinstance(event := job.step(), End):
        if isinstance(event, Emergency):
            raise CanductorError(f"{program.name}:{event.line}: M112 comes before the line")
        part_mm = max(part_mm, _drain(planner))
    if job.machine.carriages is not None:
        raise CanductorError("the positions of the carriages are no longer known: start the print again")
    return Reached(
        present_state(planner),
        {name: getattr(planner, name) for name in _DYNAMICS},
        _variables(modules),
        (*_extruder_lines(job), *(skews.restoring for skews in modules.of(Skews) if skews.restoring)),
        part_mm,
        objects,
    )


def _drain(planner: Planner) -> float:
    """Forget what is planned; return the greatest height at which anything was printed, mm."""
    high_mm = 0.0
    while (waiting := planner.take()).count:
        moves = ffi.cast("struct trapezoid *", waiting.pointer)
        high_mm = max(high_mm, lib.highest_printed(moves, waiting.count))
        planner.release(waiting.count)
    return high_mm


def _variables(modules: "Modules") -> Mapping[str, Mapping[str, Any]]:
    return {macro.name: dict(macro.variables) for macro in modules.of(GCodeMacro)}


def _extruder_lines(job: Job) -> list[str]:
    active, motion = job.machine.active, job.machine.filament
    if active is None or motion is None:
        return []
    tower = job.machine.tower
    return [
        *([] if tower is None else [f"{tuning.NAME} {tower.written}"]),
        *(
            command_line("SET_EXTRUDER_ROTATION_DISTANCE", EXTRUDER=name, DISTANCE=distance_mm)
            for name, distance_mm in motion.changed_mm.items()
        ),
        command_line("ACTIVATE_EXTRUDER", EXTRUDER=active.name),
        command_line(
            "SET_PRESSURE_ADVANCE",
            EXTRUDER=active.name,
            ADVANCE=active.pressure_advance_s,
            SMOOTH_TIME=active.smooth_s,
        ),
    ]

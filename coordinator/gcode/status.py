"""How a program's moves stand while it is read, for macros: ``printer.toolhead``, ``printer.gcode_move``."""

from collections.abc import Mapping
from typing import cast

from coordinator.gcode.machine_state import MachineState
from coordinator.gcode.place import Place
from coordinator.motion.planner.planner import Planner


def motion_figures(planner: Planner, machine: MachineState) -> Mapping[str, Mapping[str, object]]:
    """Return where the moves read so far lead to, and what holds for those to come; mm, mm/s, mm/s².

    To be called in the thread that reads programs.
    """
    limits = planner.limits
    active = machine.active
    toolhead = {
        "position": Place(*planner.toolhead_position),
        "homed_axes": planner.homed.lower(),
        "extruder": "" if active is None else active.name,
        "axis_minimum": Place(*limits.position_min, 0.0),
        "axis_maximum": Place(*limits.position_max, 0.0),
        "max_velocity": planner.max_velocity,
        "max_accel": planner.accel,
        "minimum_cruise_ratio": planner.minimum_cruise_ratio,
        "square_corner_velocity": planner.square_corner_velocity,
        "print_time": planner.print_time_end_s,
        "estimated_print_time": planner.print_time_end_s,
        "stalls": 0,
        "extra_axes": {} if active is None else {active.name: 3},
    }
    gcode_move = {
        "gcode_position": Place(*planner.gcode_position),
        "position": Place(*planner.toolhead_position),
        "base": Place(*planner.gcode_base),
        "homing_origin": Place(*planner.gcode_offset),
        "speed": planner.speed_mm_s * 60.0,
        "speed_factor": planner.speed_factor,
        "extrude_factor": planner.extrude_factor,
        "absolute_coordinates": not planner.relative,
        "absolute_extrude": not planner.relative_extrusion,
        "axis_map": {"X": 0, "Y": 1, "Z": 2, "E": 3},
    }
    return {"toolhead": toolhead, "gcode_move": gcode_move, **_extruders(machine), **_carriages(machine)}


def _extruders(machine: MachineState) -> Mapping[str, Mapping[str, object]]:
    followed = {} if machine.filament is None else machine.filament.followed
    found: dict[str, dict[str, object]] = {}
    for stepper, queue in followed.items():
        name = stepper if stepper in machine.extruders else f"extruder_stepper {stepper}"
        follows = machine.extruders.get(queue)
        found[name] = {
            "motion_queue": queue or None,
            "pressure_advance": 0.0 if follows is None else follows.pressure_advance_s,
            "smooth_time": 0.0 if follows is None else follows.smooth_s,
        }
    for name, extruder in machine.extruders.items():
        found[name] |= {"pressure_advance": extruder.pressure_advance_s, "smooth_time": extruder.smooth_s}
    return found


def _carriages(machine: MachineState) -> Mapping[str, Mapping[str, object]]:
    state, both = machine.carriage_state, machine.carriages
    if state is None or both is None:
        return {}
    modes = [mode.value for mode in state.modes]
    names = {carriage.name: mode for carriage, mode in zip(both.carriages, modes, strict=True)}
    return {"dual_carriage": {"carriage_0": modes[0], "carriage_1": modes[1], "carriages": names}}


def frames(figures: Mapping[str, Mapping[str, object]]) -> tuple[str, ...]:
    """Return the frames that a program has, each as a line: GET_POSITION."""
    at = figures["gcode_move"]
    return (
        f"toolhead: {_axes(at['position'], 'XYZE')}",
        f"gcode: {_axes(at['gcode_position'], 'XYZE')}",
        f"gcode base: {_axes(at['base'], 'XYZE')}",
        f"gcode homing: {_axes(at['homing_origin'], 'XYZ')}",
    )


def _axes(place: object, letters: str) -> str:
    values = zip(letters, cast("Place", place), strict=False)
    return " ".join(f"{letter}:{value:.6f}" for letter, value in values)

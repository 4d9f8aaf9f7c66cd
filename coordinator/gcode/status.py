"""How a program's moves stand while it is read, for macros: ``printer.toolhead``, ``printer.gcode_move``."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self, cast

from coordinator.gcode.machine_state import MachineState
from coordinator.gcode.place import Place
from coordinator.motion.planner.planner import Planner, PlannerState

Figures = Mapping[str, Mapping[str, object]]


@dataclass(frozen=True, slots=True)
class MotionStatus:
    """Where the moves read so far lead to, and what holds for those to come."""

    state: PlannerState
    active: str
    """The extruder that E stands for; empty: there is none."""
    parts: Figures
    """Extruders and carriages."""

    @classmethod
    def of(cls, planner: Planner, machine: MachineState) -> Self:
        """Return it; to be called in the thread that reads programs."""
        active = machine.active
        name = "" if active is None else active.name
        return cls(planner.state(), name, {**_extruders(machine), **_carriages(machine)})

    def figures(self) -> Figures:
        """Return it as macros see it; mm, mm/s, mm/s²."""
        state, limits = self.state, self.state.limits
        toolhead = {
            "position": Place(*state.toolhead_position),
            "homed_axes": state.homed.lower(),
            "extruder": self.active,
            "axis_minimum": Place(*limits.position_min, 0.0),
            "axis_maximum": Place(*limits.position_max, 0.0),
            "max_velocity": state.max_velocity,
            "max_accel": state.accel,
            "minimum_cruise_ratio": state.minimum_cruise_ratio,
            "square_corner_velocity": state.square_corner_velocity,
            "print_time": state.print_time_end_s,
            "estimated_print_time": state.print_time_end_s,
            "stalls": 0,
            "extra_axes": {self.active: 3} if self.active else {},
        }
        gcode_move = {
            "gcode_position": Place(*state.gcode_position),
            "position": Place(*state.toolhead_position),
            "base": Place(*state.gcode_base),
            "homing_origin": Place(*state.gcode_offset),
            "speed": state.speed_mm_s * 60.0,
            "speed_factor": state.speed_factor,
            "extrude_factor": state.extrude_factor,
            "absolute_coordinates": not state.relative,
            "absolute_extrude": not state.relative_extrusion,
            "axis_map": {"X": 0, "Y": 1, "Z": 2, "E": 3},
        }
        return {"toolhead": toolhead, "gcode_move": gcode_move, **self.parts}


def _extruders(machine: MachineState) -> Figures:
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


def _carriages(machine: MachineState) -> Figures:
    state, both = machine.carriage_state, machine.carriages
    if state is None or both is None:
        return {}
    modes = [mode.value for mode in state.modes]
    names = {carriage.name: mode for carriage, mode in zip(both.carriages, modes, strict=True)}
    return {"dual_carriage": {"carriage_0": modes[0], "carriage_1": modes[1], "carriages": names}}


def frames(figures: Figures) -> tuple[str, ...]:
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

"""``toolhead``, ``gcode_move``, ``motion_report``: where the head is and what holds for the lines to come."""

from typing import Any

from coordinator.config.model import SECOND_CARRIAGE, MachineDescription
from coordinator.kinematics.dual_carriage import CarriageMode
from coordinator.service.core.motion import Motion

Objects = dict[str, dict[str, Any]]


def motion_objects(motion: "Motion", described: "MachineDescription", *, stopped: bool) -> Objects:
    """Return them, with extruders' and carriages' figures; positions are lists of X Y Z E in mm."""
    status = motion.planned.status
    objects: Objects = {name: dict(fields) for name, fields in status.figures().items()}
    toolhead, move = objects["toolhead"], objects["gcode_move"]
    for fields in (toolhead, move):
        fields.update((name, list(value)) for name, value in fields.items() if isinstance(value, tuple))
    toolhead["homed_axes"] = "".join(axis for axis in "xyz" if axis in toolhead["homed_axes"])
    toolhead["print_time"] = round(float(toolhead["print_time"]), 3)
    toolhead["estimated_print_time"] = toolhead["print_time"] if stopped else round(motion.now_s, 3)
    move["gcode_position"] = [round(value * status.state.unit_mm, 6) for value in move["gcode_position"]]
    objects["motion_report"] = _report(motion, described, stopped=stopped)
    return objects


def _report(motion: "Motion", described: "MachineDescription", *, stopped: bool) -> dict[str, Any]:
    position, speed, extruder = motion.planned.state.toolhead_position, 0.0, 0.0
    if not stopped:
        moment = motion.moment()
        position, speed, extruder = moment.position, moment.velocity_mm_s, moment.extruder_mm_s
    return {
        "live_position": [round(value, 6) for value in position],
        "live_velocity": round(speed, 3),
        "live_extruder_velocity": round(extruder, 4),
        **_names(described),
    }


def _names(described: "MachineDescription") -> dict[str, Any]:
    steppers = [stepper.name for stepper in described.steppers]
    return {"steppers": steppers, "trapq": ["toolhead", *(extruder.name for extruder in described.extruders)]}


def idle_objects(described: "MachineDescription") -> Objects:
    """Return the same of a machine that is not ready yet: its limits, and nothing homed.

    All fields are there: a client that watches a whole object gets those that it has at that moment.
    """
    limits, extruder = described.limits, described.extruder
    active = "" if extruder is None else extruder.name
    nowhere = [0.0] * 4
    toolhead = {
        "position": nowhere,
        "homed_axes": "",
        "extruder": active,
        "axis_minimum": [*limits.position_min, 0.0],
        "axis_maximum": [*limits.position_max, 0.0],
        "max_velocity": limits.max_velocity,
        "max_accel": limits.max_accel,
        "minimum_cruise_ratio": limits.minimum_cruise_ratio,
        "square_corner_velocity": limits.square_corner_velocity,
        "print_time": 0.0,
        "estimated_print_time": 0.0,
        "stalls": 0,
        "extra_axes": {active: 3} if active else {},
    }
    gcode_move = {
        "gcode_position": nowhere,
        "position": nowhere,
        "base": nowhere,
        "homing_origin": nowhere,
        "speed": 0.0,
        "speed_factor": 1.0,
        "extrude_factor": 1.0,
        "absolute_coordinates": True,
        "absolute_extrude": True,
        "axis_map": {"X": 0, "Y": 1, "Z": 2, "E": 3},
    }
    report = {
        "live_position": nowhere,
        "live_velocity": 0.0,
        "live_extruder_velocity": 0.0,
        **_names(described),
    }
    objects = {"toolhead": toolhead, "gcode_move": gcode_move, "motion_report": report}
    for follower in described.extruder_steppers:
        objects[f"extruder_stepper {follower.name}"] = {"motion_queue": follower.extruder or None}
    for each in described.extruders:
        objects[each.name] = {
            "motion_queue": each.name,
            "pressure_advance": each.pressure_advance,
            "smooth_time": each.smooth_time_s,
        }
    if described.dual_carriage is not None:
        objects[SECOND_CARRIAGE] = {
            "carriage_0": CarriageMode.PRIMARY.value,
            "carriage_1": CarriageMode.INACTIVE.value,
        }
    return objects

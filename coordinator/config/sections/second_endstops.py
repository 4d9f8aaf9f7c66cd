"""Endstops of further steppers: where an axis has its steppers to itself, each side may have its own."""

from dataclasses import replace

from coordinator.config.model import RailDescription, Unsupported
from coordinator.config.sections.kinematics.frame import Frame
from coordinator.config.sections.reading import Reading


def with_second_endstops(reading: Reading, frame: Frame) -> Frame:
    """Return FRAME with them; those that cannot act are noted as such.

    A stepper that names the pin of its rail's endstop has no endstop of its own.
    """
    rails = tuple(_with_own(reading, frame, rail) for rail in frame.rails)
    acting = {name for rail in rails for name, _, _ in rail.second_endstops}
    for name, second in reading.second_endstops.items():
        pin = second.pin
        shared = any(
            rail.homing.endstop_pin is not None
            and (rail.homing.endstop_pin.node, rail.homing.endstop_pin.name) == (pin.node, pin.name)
            for rail in frame.rails
        )
        if name not in acting and not shared:
            reading.unsupported.append(Unsupported(second.section, second.place, ("endstop_pin",)))
    dual = frame.dual_carriage
    if dual is not None:
        same = dict(zip((rail.axis for rail in frame.rails), rails, strict=True))
        dual = replace(dual, rails=(same[dual.rails[0].axis], dual.rails[1]))
    return replace(frame, rails=rails, dual_carriage=dual)


def _with_own(reading: Reading, frame: Frame, rail: RailDescription) -> RailDescription:
    pin = rail.homing.endstop_pin
    if pin is None or not _moves_by_itself(frame, rail):
        return rail
    own = tuple(
        (stepper.name, second.pin, second.virtual)
        for stepper in rail.steppers[1:]
        if (second := reading.second_endstops.get(stepper.name)) is not None
    )
    others = tuple(
        (name, found, virtual)
        for name, found, virtual in own
        if (found.node, found.name) != (pin.node, pin.name)
    )
    return replace(rail, second_endstops=others)


def _moves_by_itself(frame: Frame, rail: RailDescription) -> bool:
    """Return whether RAIL is an axis, its steppers move nothing else, and nothing else moves it."""
    if rail.axis not in "xyz":
        return False
    axis = "xyz".index(rail.axis)
    for motor in frame.steppers:
        own = motor in rail.steppers
        function = motor.function
        moves = motor.weights[axis] != 0 if function.linear else rail.axis in function.axes
        others = any(weight for number, weight in enumerate(motor.weights) if number != axis)
        if moves != own or (own and others):
            return False
    return True

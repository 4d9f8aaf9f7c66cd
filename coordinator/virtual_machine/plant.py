"""The plant of a configured machine: what stands around its virtual nodes so that homing and heating do work.

Every stepper is counted where it is driven; every rail's endstop stands where the configuration says, and
switches by the steppers of all nodes that move its axis. The heat is in ``plant_heat.py``.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from coordinator.config.model import SECOND_CARRIAGE, MachineDescription, RailDescription, StepperDescription
from coordinator.kinematics.base import Point
from coordinator.kinematics.delta import Delta
from coordinator.virtual_machine.plant_bed import BedSettings, ProbeParts, load_cells, probe_parts
from coordinator.virtual_machine.plant_heat import BED_BODY, HeatSettings, NodeHeat, machine_heat
from coordinator.virtual_machine.plant_tmc import machine_drivers
from nodes.support.errors import CanductorError
from nodes.virtual.plant import Axis, Bed, Coil, LoadCell, NodePlant, Stepper, Switch, Term

AXES: Final = "xyz"
START_MM: Final = 30.0
"""How far from where it is after homing the head begins, along each axis, unless set otherwise."""
BEYOND_MM: Final = 5.0
"""How far behind the end of an axis its stop stands."""
RAD_PER_MM: Final = 0.01
"""Of a rail that turns, these lengths are as small angles as of an arm of 100 mm."""
DIGITS: Final = 12
_SMALL: Final = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantSettings:
    """How the machine is to be."""

    seed: int = 1
    start: Point | None = None
    """Where the head stands at the begin, mm; None: some way from where it homes to."""
    stops: bool = True
    """Whether steps beyond the ends of an axis are lost."""
    enable_pins: bool = True
    """Whether a motor whose enable pin is off stands still."""
    hysteresis_mm: float = 0.1
    """Travel of an endstop from where it closes to where it opens."""
    skew_mm: Mapping[str, float] = field(default_factory=dict)
    """Initial offset from the head of a side of an axis that has its own endstop, by its first motor."""
    switch_noise_mm: float = 0.0
    """Largest deviation of an endstop's switching position from one approach to the next."""
    bed: BedSettings = field(default_factory=BedSettings)
    """What the probe finds, and how exactly."""
    heat: HeatSettings = field(default_factory=HeatSettings)


def machine_plants(
    description: MachineDescription, settings: PlantSettings | None = None
) -> dict[str, NodePlant]:
    """Return the plants of the machine's nodes, by node; raises CanductorError when it cannot have one."""
    settings = settings or PlantSettings()
    start = settings.start or start_point(description)
    try:
        rails = description.kinematics.inverse(start)
    except ValueError:
        raise CanductorError(f"the head of the plant cannot begin at {start}: no rail reaches it") from None
    endstops = [
        _endstop(description, rail, start, rails, settings)
        for rail in _rails(description)
        if rail.homing.endstop_pin is not None
    ]
    probe = _probe(description, start, rails, settings)
    plants = [_mechanics(description, node.name, endstops, settings) for node in description.nodes]
    heat = machine_heat(description, settings.heat)
    if probe is not None:
        probe = replace(probe, bed=_warmed(probe.bed, heat))
        plants = [_with_probe(plant, probe) for plant in plants]
    scales = load_cells(description, settings.bed)
    drivers = machine_drivers(description)
    return {
        plant.node: replace(
            plant,
            seed=settings.seed + number,
            ambient=settings.heat.ambient_c,
            tmcs=tuple(drivers[plant.node].tmcs),
            diags=tuple(drivers[plant.node].diags),
            load_cells=(*plant.load_cells, *scales.get(plant.node, ())),
            **heat[plant.node].parts(),
        )
        for number, plant in enumerate(plants)
    }


def start_point(description: MachineDescription, away_mm: float = START_MM) -> Point:
    """Return a place AWAY_MM from where the head is after homing, along each axis, towards the middle."""
    home = np.array(description.home)
    space = description.kinematics.work_space
    middle = (np.array(space.low) + np.array(space.high)) / 2
    x, y, z = home + np.clip(middle - home, -away_mm, away_mm)
    return (float(x), float(y), float(z))


def _rails(description: MachineDescription) -> Iterator[RailDescription]:
    for rail in description.rails:
        yield from rail.pieces
    if description.second_carriage is not None:
        yield description.second_carriage


def _mechanics(
    description: MachineDescription,
    node: str,
    endstops: Sequence[tuple[str, Switch | None, Axis]],
    settings: PlantSettings,
) -> NodePlant:
    own = [(switch, axis) for at, switch, axis in endstops if at == node and switch is not None]
    # An axis with stops is also known where its steppers are.
    moved = [
        axis
        for _, switch, axis in endstops
        if any(term.node == node for term in axis.terms) and (settings.stops or switch is None)
    ]
    axes = {axis.name: axis for axis in moved}
    axes |= {axis.name: axis for _, axis in own}
    return NodePlant(
        node=node,
        steppers=tuple(_stepper(s, settings) for s in description.steppers if s.node == node),
        axes=tuple(axes.values()),
        switches=tuple(switch for switch, _ in own),
    )


def _probe(
    description: MachineDescription, start: Point, rails: Sequence[float], settings: PlantSettings
) -> ProbeParts | None:
    """Return the probe with its axes; None: there is none, or it is not known where the nozzle is.

    That is known of a delta whose probe is a switch, and where X and Y are sums of motors.
    """
    if description.probe is None:
        return None
    pin = description.probe.rail.homing.endstop_pin
    if isinstance(configured := description.kinematics, Delta) and pin is not None and not pin.sensor:
        joints = _joints(description, configured, settings.bed.delta or configured, rails)
        return probe_parts(description, joints, settings.bed)
    terms = [_axis_terms(description, replace(description.rails[0], axis=letter)) for letter in AXES]
    if not all(terms):
        return None
    axes = [Axis(name=f"probe_{a}", terms=t, origin=o) for a, t, o in zip(AXES, terms, start, strict=True)]
    return probe_parts(description, axes, settings.bed)


def _joints(
    description: MachineDescription, configured: Delta, true: Delta, rails: Sequence[float]
) -> list[Axis]:
    """Return the heights of a delta's joints: the motors know where the CONFIGURED endstops are."""
    by_name = {rail.axis: rail.steppers for rail in description.rails}
    ends = zip(configured.endstop_positions, true.endstop_positions, strict=True)
    return [
        Axis(
            name=f"joint_{name}",
            terms=tuple(Term(s.node, s.name, s.step_distance / len(by_name[name])) for s in by_name[name]),
            origin=at + true_end - end,
        )
        for name, at, (end, true_end) in zip(configured.rails, rails, ends, strict=True)
    ]


def _with_probe(plant: NodePlant, parts: ProbeParts) -> NodePlant:
    if parts.node != plant.node:
        return plant
    axes = (*plant.axes, *parts.axes)
    if isinstance(parts.probe, Coil):
        return replace(plant, axes=axes, beds=(parts.bed,), coils=(parts.probe,))
    if isinstance(parts.probe, LoadCell):
        return replace(plant, axes=axes, beds=(parts.bed,), load_cells=(parts.probe,))
    return replace(plant, axes=axes, beds=(parts.bed,), probes=(parts.probe,), deltas=parts.deltas)


def _warmed(bed: Bed, heat: Mapping[str, NodeHeat]) -> Bed:
    """Return the bed with what warms it, where that bends it: the body of [heater_bed]."""
    if not bed.warm_bow or bed.body is not None:
        return bed
    for node, of_node in heat.items():
        if any(body.name == BED_BODY for body in of_node.bodies):
            return replace(bed, node=node, body=BED_BODY)
    raise CanductorError("the bed of the plant has a warm_bow, but nothing warms it; add [heater_bed]")


def _stepper(stepper: StepperDescription, settings: PlantSettings) -> Stepper:
    enable = stepper.enable_pin if settings.enable_pins else None
    if enable is not None and enable.node != stepper.node:
        enable = None  # its driver hangs on another node's pin, which this plant does not see
    return Stepper(
        name=stepper.name,
        step_pin=stepper.step_pin.name,
        dir_pin=stepper.dir_pin.name,
        enable_pin=None if enable is None else enable.name,
        step_inverted=stepper.step_pin.invert,
        dir_inverted=stepper.dir_pin.invert,
        enable_inverted=enable is not None and enable.invert,
        both_edges=stepper.step_pulse_s == 0,
    )


# ------------------------------------------------------------------------------------------------ endstops


def _endstop(
    description: MachineDescription,
    rail: RailDescription,
    start: Point,
    rails: Sequence[float],
    settings: PlantSettings,
) -> tuple[str, Switch | None, Axis]:
    """Return the node, the switch and the axis of RAIL's endstop; one that is felt is the stop itself."""
    pin, name = rail.homing.endstop_pin, rail.steppers[0].name
    assert pin is not None
    if rail in description.rails and rail.axis in AXES and (terms := _axis_terms(description, rail)):
        origin, at = start[AXES.index(rail.axis)], rail.homing.position_endstop
        name = rail.axis
    else:
        terms = tuple(Term(s.node, s.name, s.step_distance / len(rail.steppers)) for s in rail.steppers)
        origin, at = _own_places(description, rail, start, rails)
        origin += settings.skew_mm.get(name, 0.0)
    assert at is not None
    direction = 1 if rail.homing.positive_dir else -1
    unit = RAD_PER_MM if rail.steppers[0].function.turns else 1.0
    low, high = _stops(rail, at, BEYOND_MM * unit) if settings.stops else (-np.inf, np.inf)
    if rail.homing.by_probe:
        return pin.node, None, Axis(name=name, terms=terms, origin=origin, min=low, max=high)
    if rail.homing.virtual_endstop:
        low, high = _stops(rail, at, 0.0)
        return pin.node, None, Axis(name=name, terms=terms, origin=origin, min=low, max=high)
    switch = Switch(
        name=name,
        pin=pin.name,
        axis=name,
        at=at,
        direction=direction,
        hysteresis=settings.hysteresis_mm * unit,
        noise=settings.switch_noise_mm * unit,
        inverted=pin.invert,
    )
    return pin.node, switch, Axis(name=name, terms=terms, origin=origin, min=low, max=high)


def _own_places(
    description: MachineDescription, rail: RailDescription, start: Point, rails: Sequence[float]
) -> tuple[float, float | None]:
    """Return where a rail that is no axis, or a part of one, is at the begin and at its endstop."""
    at = rail.homing.position_endstop
    if rail.axis == SECOND_CARRIAGE:  # parked at its endstop, nearly
        assert at is not None
        return (at - START_MM if rail.homing.positive_dir else at + START_MM), at
    if rail not in description.rails:  # one side of an axis
        axis = next(whole.axis for whole in description.rails if rail in whole.pieces)
        return start[AXES.index(axis)], at
    index = description.kinematics.rails.index(rail.axis)
    return rails[index], description.kinematics.inverse(description.home)[index]


def _stops(rail: RailDescription, at: float, beyond: float) -> tuple[float, float]:
    """Return where an axis ends: behind its range; where there is none, only behind its endstop."""
    upper = rail.homing.positive_dir
    low = rail.position_min if rail.position_min is not None else -np.inf if upper else at
    high = rail.position_max if rail.position_max is not None else at if upper else np.inf
    return min(low, at) - beyond, max(high, at) + beyond


def _axis_terms(description: MachineDescription, rail: RailDescription) -> tuple[Term, ...]:
    """Return how the place of RAIL's axis follows from steppers that are sums of axes; empty: it does not."""
    motors = _motors(description)
    weights = np.array([motor.weights[:3] for motor in motors]).reshape(-1, 3)
    axis = np.zeros(3)
    axis[AXES.index(rail.axis)] = 1.0
    solution = np.linalg.pinv(weights).T @ axis if len(motors) else axis[:0]
    if not np.allclose(weights.T @ solution, axis, atol=_SMALL):
        return ()
    return tuple(
        Term(motor.node, motor.name, round(float(share), DIGITS) * motor.step_distance)
        for motor, share in zip(motors, solution, strict=True)
        if abs(share) > _SMALL
    )


def _motors(description: MachineDescription) -> list[StepperDescription]:
    """Return the motors that are sums of axes, but for those of a second carriage."""
    dual = description.dual_carriage
    others = [stepper.name for stepper in dual.rails[1].steppers] if dual is not None else []
    linear = [m for m in description.motors if m.function.linear]
    return [motor for motor in linear if motor.name not in others]

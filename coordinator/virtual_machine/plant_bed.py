"""The bed of a configured machine with the probe that feels it, and the frame that several Z motors carry."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from coordinator.config.file import parse_config
from coordinator.config.model import MachineDescription
from coordinator.config.pins import PinOption
from coordinator.config.sections.nodes import make_pin_registry
from nodes.support.errors import CanductorError
from nodes.virtual.plant import Axis, Bed, Probe, Term

_CONTROL: Final = PinOption(name="control_pin", help="", share="plant")


@dataclass(frozen=True, slots=True, kw_only=True)
class BedSettings:
    """What the probe of a machine feels, and how exactly."""

    shape: Bed = field(default_factory=Bed)
    noise_mm: float = 0.0
    """Largest deviation of the height at which it triggers, from one approach to the next."""
    hysteresis_mm: float = 0.05
    """Way up from where it triggers to where it lets go."""
    z_offset_mm: float | None = None
    """How high the nozzle truly is when it triggers; None: as configured."""
    lean_x: float = 0.0
    """How much higher it triggers per mm along X, where the axis is twisted; from x0 of the bed on."""
    lean_y: float = 0.0
    supports: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """X and Y of where each motor of Z carries the frame; none: it cannot tilt. The frame is a plane, where
    more than three carry it the one that fits best."""
    raised_mm: Mapping[str, float] = field(default_factory=dict)
    """How much higher the frame begins at a motor's support."""


@dataclass(frozen=True, slots=True)
class ProbeParts:
    """What the plant of one node gets."""

    node: str
    axes: tuple[Axis, ...]
    bed: Bed
    probe: Probe


def probe_parts(description: MachineDescription, axes: Sequence[Axis], settings: BedSettings) -> ProbeParts:
    """Return the probe of a machine whose X, Y and Z are AXES, which the nodes' motors move."""
    described = description.probe
    assert described is not None
    pin = described.rail.homing.endstop_pin
    assert pin is not None
    x, y, z = axes
    tilts: tuple[Axis, ...] = ()
    if settings.supports:
        z, *tilts_ = frame_axes(description, z, settings)
        tilts = tuple(tilts_)
    true_z = described.offset[2] if settings.z_offset_mm is None else settings.z_offset_mm
    probe = Probe(
        name="probe",
        pin=pin.name,
        bed=settings.shape.name,
        x=x.name,
        y=y.name,
        z=z.name,
        slope_x=tilts[0].name if tilts else None,
        slope_y=tilts[1].name if tilts else None,
        offset_x=described.offset[0],
        offset_y=described.offset[1],
        offset_z=true_z,
        hysteresis=settings.hysteresis_mm,
        noise=settings.noise_mm,
        inverted=pin.invert,
        lean_x=settings.lean_x,
        lean_y=settings.lean_y,
        control_pin=_control_pin(description, described.section, pin.node),
    )
    return ProbeParts(pin.node, (x, y, z, *tilts), settings.shape, probe)


def _control_pin(description: MachineDescription, section: str, node: str) -> str | None:
    """Return the pin that moves the pin of a BLTouch; None: SECTION is another kind of probe."""
    if section != "bltouch":
        return None
    config = parse_config(description.path)
    given, registry = config.sections[section], make_pin_registry(config, description.nodes)
    name = _CONTROL.parse(given.options[_CONTROL.name].value)
    pin = registry.claim(name, _CONTROL, given)
    if pin.node != node:
        raise CanductorError(
            f"[{section}] has its sensor_pin on node {node} and its control_pin on {pin.node}; the plant of a"
            " demo can only have both on one node"
        )
    return pin.name


def frame_axes(description: MachineDescription, z: Axis, settings: BedSettings) -> tuple[Axis, Axis, Axis]:
    """Return the height of the frame at x = y = 0 and its slopes along X and Y, by the motors that carry it.

    The frame is the plane nearest to the heights of its supports.
    """
    motors = {motor.name: motor for motor in description.motors}
    names = list(settings.supports)
    places = np.array([(1.0, *settings.supports[name]) for name in names])
    shares = np.linalg.pinv(places)
    raised = np.array([z.origin + settings.raised_mm.get(name, 0.0) for name in names])
    found = []
    for name, row in zip(("probe_z", "probe_slope_x", "probe_slope_y"), shares, strict=True):
        terms = tuple(
            Term(motors[motor].node, motor, float(share) * motors[motor].step_distance)
            for motor, share in zip(names, row, strict=True)
        )
        found.append(replace(z, name=name, terms=terms, origin=float(row @ raised)))
    height, slope_x, slope_y = found
    return height, slope_x, slope_y

"""The bed of a configured machine with the probe that feels it, and the frame that several Z motors carry."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from coordinator.config.file import RawSection, parse_config
from coordinator.config.model import MachineDescription
from coordinator.config.pins import PinOption
from coordinator.config.sections.nodes import make_pin_registry
from coordinator.config.sections.probe import DOUT, LOAD_CELL
from coordinator.kinematics.delta import Delta
from coordinator.virtual_machine.plant_heat import COIL_SENSOR, plant_word
from nodes.devices.hx71x import CHIPS
from nodes.support.errors import CanductorError
from nodes.virtual import plant
from nodes.virtual.plant import Axis, Bed, Coil, LoadCell, Probe, Term

_BUSES: Final = ("i2c1", "i2c2")
"""Of a virtual node."""
_CONTROL: Final = PinOption(name="control_pin", help="", share="plant")


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadCellSettings:
    """The load cell that carries the nozzle, as it truly is."""

    counts_per_gram: float = 100.0
    zero: float = 20_000.0
    """Counts without any force."""
    stiffness: float = 4000.0
    """g/mm."""
    drift: float = 0.0
    """g/s."""
    hum: float = 0.0
    """g, at hum_hz."""
    hum_hz: float = 50.0
    noise: float = 0.0
    """Counts, standard deviation of a reading."""
    rate: float = 1.0
    """Conversions per second, as a share of sample_rate."""


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
    coil_noise_hz: float = 0.0
    """Standard deviation of a reading of an eddy current probe."""
    coil_drift: float = 0.0
    """How much the frequency of its coil grows per K, as a share."""
    coil_clock: float = 1.0
    """How fast the reference clock of its chip truly is, as a share of the configured frequency."""
    load_cell: LoadCellSettings = field(default_factory=LoadCellSettings)
    lean_x: float = 0.0
    """How much higher it triggers per mm along X, where the axis is twisted; from x0 of the bed on."""
    lean_y: float = 0.0
    supports: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """X and Y of where each motor of Z carries the frame; none: it cannot tilt. The frame is a plane, where
    more than three carry it the one that fits best."""
    delta: Delta | None = None
    """Of a delta, what it truly is; None: as configured."""
    raised_mm: Mapping[str, float] = field(default_factory=dict)
    """How much higher the frame begins at a motor's support."""


@dataclass(frozen=True, slots=True)
class ProbeParts:
    """What the plant of one node gets."""

    node: str
    axes: tuple[Axis, ...]
    bed: Bed
    probe: Probe | Coil | LoadCell
    deltas: tuple[plant.Delta, ...] = ()


def probe_parts(description: MachineDescription, axes: Sequence[Axis], settings: BedSettings) -> ProbeParts:
    """Return the probe of a machine whose X, Y and Z, or a delta's joints, are AXES, which motors move."""
    described = description.probe
    assert described is not None
    pin = described.rail.homing.endstop_pin
    assert pin is not None
    x, y, z = axes
    tilts: tuple[Axis, ...] = ()
    delta = None
    if isinstance(description.kinematics, Delta):
        delta = _delta(settings.delta or description.kinematics, axes)
    elif settings.supports:
        z, *tilts_ = frame_axes(description, z, settings)
        tilts = tuple(tilts_)
    if described.section == LOAD_CELL:
        cell = _load_cell(description, settings, (x, y, z, *tilts))
        return ProbeParts(pin.node, (x, y, z, *tilts), settings.shape, cell)
    if pin.sensor:
        coil = _coil(description, settings, (x, y, z, *tilts))
        return ProbeParts(pin.node, (x, y, z, *tilts), settings.shape, coil)
    true_z = described.offset[2] if settings.z_offset_mm is None else settings.z_offset_mm
    probe = Probe(
        name="probe",
        pin=pin.name,
        bed=settings.shape.name,
        x=None if delta else x.name,
        y=None if delta else y.name,
        z=None if delta else z.name,
        delta=None if delta is None else delta.name,
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
    return ProbeParts(pin.node, (x, y, z, *tilts), settings.shape, probe, () if delta is None else (delta,))


def _delta(true: Delta, joints: Sequence[Axis]) -> plant.Delta:
    """Return the TRUE delta whose JOINTS have these heights."""
    a, b, c = joints
    (ax, ay), (bx, by), (cx, cy) = true.feet
    rod_a, rod_b, rod_c = (tower.rod_length for tower in true.towers)
    return plant.Delta(
        a=a.name,
        ax=ax,
        ay=ay,
        rod_a=rod_a,
        b=b.name,
        bx=bx,
        by=by,
        rod_b=rod_b,
        c=c.name,
        cx=cx,
        cy=cy,
        rod_c=rod_c,
    )


def _coil(description: MachineDescription, settings: BedSettings, axes: Sequence[Axis]) -> Coil:
    """Return the coil of an eddy current probe at NODE; X, Y, Z and perhaps slopes are AXES."""
    described = description.probe
    assert described is not None
    given = _options(description, described.section)
    x, y, z, *slopes = axes
    assert described.rail.homing.endstop_pin is not None
    return Coil(
        name="probe",
        bus=_BUSES.index(given.get("i2c_bus", _BUSES[0])),
        address=int(given.get("i2c_address", "42")),
        bed=settings.shape.name,
        x=x.name,
        y=y.name,
        z=z.name,
        slope_x=slopes[0].name if slopes else None,
        slope_y=slopes[1].name if slopes else None,
        offset_x=described.offset[0],
        offset_y=described.offset[1],
        intb_pin=_bare(given["intb_pin"]) if "intb_pin" in given else None,
        body=_coil_body(description, described.section, described.rail.homing.endstop_pin.node),
        clock=float(given.get("frequency", "12e6")) * settings.coil_clock,
        drift=settings.coil_drift,
        noise=settings.coil_noise_hz,
    )


def _load_cell(description: MachineDescription, settings: BedSettings, axes: Sequence[Axis]) -> LoadCell:
    """Return the load cell of a probe that is the nozzle; X, Y, Z and perhaps slopes are AXES."""
    assert description.probe is not None
    x, y, z, *slopes = axes
    return replace(
        _cell("probe", parse_config(description.path).sections[description.probe.section], settings),
        bed=settings.shape.name,
        x=x.name,
        y=y.name,
        z=z.name,
        slope_x=slopes[0].name if slopes else None,
        slope_y=slopes[1].name if slopes else None,
    )


def load_cells(description: MachineDescription, settings: BedSettings) -> dict[str, tuple[LoadCell, ...]]:
    """Return the scales of [load_cell] sections by node; nothing is on them but drift and hum."""
    found: dict[str, tuple[LoadCell, ...]] = {}
    for name, section in parse_config(description.path).sections.items():
        if section.kind == "load_cell":
            node = DOUT.parse(section.options[DOUT.name].value).node
            found[node] = (*found.get(node, ()), _cell(name.replace(" ", "_"), section, settings))
    return found


def _cell(name: str, section: RawSection, settings: BedSettings) -> LoadCell:
    """Return the load cell of SECTION, without what presses against it."""
    given = {name: option.value for name, option in section.options.items()}
    cell = settings.load_cell
    return LoadCell(
        name=name,
        dout_pin=_bare(given["dout_pin"]),
        sclk_pin=_bare(given["sclk_pin"]),
        rate=float(given.get("sample_rate", CHIPS[given["sensor_type"]].rates[0])) * cell.rate,
        counts_per_gram=cell.counts_per_gram,
        zero=cell.zero,
        stiffness=cell.stiffness,
        drift=cell.drift,
        hum=cell.hum,
        hum_hz=cell.hum_hz,
        noise=cell.noise,
    )


def _options(description: MachineDescription, section: str) -> dict[str, str]:
    """Return what is given in SECTION; none where it is not there."""
    found = parse_config(description.path).sections.get(section)
    return {} if found is None else {name: option.value for name, option in found.options.items()}


def _coil_body(description: MachineDescription, section: str, node: str) -> str | None:
    """Return the body that warms the coil of SECTION on NODE; None: it is as warm as the air."""
    sensor = f"{COIL_SENSOR} {section.partition(' ')[2]}"
    pin = _options(description, sensor).get("sensor_pin")
    return plant_word(sensor) if pin is not None and _CONTROL.parse(pin).node == node else None


def _bare(pin: str) -> str:
    """Return the name of a PIN on its node."""
    return pin.rpartition(":")[2].strip("!^~ ")


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

"""Description of the plant of a virtual node: what its pins are connected to, as the firmware reads it.

Parts have names of at most 63 characters without blanks. Lengths are in mm (of an angle:
rad), temperatures in °C, powers in W, capacities in J/K, conductances in W/K, resistances in ohm, times in s.
The text's format and what each part does: docs/plant.md.
"""

import dataclasses
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from nodes.support.errors import CanductorError

NAME_MAX: Final = 63


@dataclass(frozen=True, slots=True, kw_only=True)
class Stepper:
    """A motor with its driver, on pins of the plant's own node."""

    name: str
    step_pin: str
    dir_pin: str
    enable_pin: str | None = None
    """None: the driver is always on."""
    step_inverted: bool = False
    dir_inverted: bool = False
    """Whether the stepper counts up while its direction pin is low."""
    enable_inverted: bool = False
    both_edges: bool = False


@dataclass(frozen=True, slots=True)
class Term:
    """Movement of an axis by each step of STEPPER on NODE."""

    node: str
    stepper: str
    mm_per_step: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """Position along a line, moved by steppers of any nodes; ORIGIN: with all counts at 0.

    A step that would move it beyond a limit is lost if the plant of that stepper's node contains the axis.
    """

    name: str
    terms: tuple[Term, ...]
    origin: float = 0.0
    min: float = -math.inf
    max: float = math.inf


@dataclass(frozen=True, slots=True, kw_only=True)
class Switch:
    """An endstop: pressed while its axis is at or beyond AT, in DIRECTION (1 or -1).

    It is released HYSTERESIS before AT; each approach triggers it up to NOISE away from AT.
    """

    name: str
    pin: str
    axis: str
    at: float
    direction: int
    hysteresis: float = 0.0
    noise: float = 0.0
    inverted: bool = False
    """Whether pressed is a low level."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Bed:
    """A bed, tilted and bowed.

    Its height at x, y is z + tilt_x·dx + tilt_y·dy + bow·(1 - (dx² + dy²) / radius²), where dx is x - x0 and
    dy is y - y0.
    """

    name: str = "bed"
    z: float = 0.0
    x0: float = 0.0
    y0: float = 0.0
    tilt_x: float = 0.0
    """mm per mm, as ``tilt_y``."""
    tilt_y: float = 0.0
    bow: float = 0.0
    """How much higher its middle is than a circle of ``radius`` around it."""
    radius: float = 100.0
    node: str | None = None
    """Of the body that warms it."""
    body: str | None = None
    warm_bow: float = 0.0
    """mm that ``bow`` grows per K by which that body is warmer than the ambient."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Delta:
    """A delta: joints at fixed X and Y, whose heights are axes A, B and C, hold the nozzle by rods."""

    name: str = "delta"
    a: str
    ax: float
    ay: float
    rod_a: float
    b: str
    bx: float
    by: float
    rod_b: float
    c: str
    cx: float
    cy: float
    rod_c: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Probe:
    """A switch at the head that BED presses: pressed while the nozzle is OFFSET_Z above the bed, or lower.

    OFFSET_X, OFFSET_Y: its place from the nozzle. X, Y and Z are axes, or DELTA has the nozzle; where SLOPE_X
    and SLOPE_Y are axes as well (mm per mm), Z is the nozzle's height at x = y = 0. Hysteresis and noise as
    of a switch.
    """

    name: str
    pin: str
    bed: str
    x: str | None = None
    y: str | None = None
    z: str | None = None
    delta: str | None = None
    slope_x: str | None = None
    slope_y: str | None = None
    offset_x: float = 0.0
    offset_y: float = 0.0
    offset_z: float = 0.0
    hysteresis: float = 0.0
    noise: float = 0.0
    inverted: bool = False
    """Pressed is a low level."""
    control_pin: str | None = None
    """Input of a BLTouch for the servo's signal that moves its pin; None: it is a plain switch."""
    lean_x: float = 0.0
    """By how much OFFSET_Z grows per mm that the probe is away from x0 of the bed: of a twisted axis."""
    lean_y: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Coil:
    """The coil of an eddy current probe with its LDC1612 at ADDRESS of I2C bus number BUS.

    Its frequency, in Hz, is far·(1 + gain·e^(-h / reach))·(1 + drift·(T - 25 °C)), where h is the height of
    the nozzle above BED at the place of the coil, OFFSET_X, OFFSET_Y from the nozzle. X, Y, Z and the slopes
    are axes as of a probe; T is the temperature of BODY.
    """

    name: str
    bus: int
    address: int
    bed: str
    x: str
    y: str
    z: str
    slope_x: str | None = None
    slope_y: str | None = None
    offset_x: float = 0.0
    offset_y: float = 0.0
    offset_z: float = 0.0
    intb_pin: str | None = None
    body: str | None = None
    """None: it has ambient temperature."""
    drive: int = 15
    """Drive current (0 to 31) at which its amplitude is right; 3 more or less are possible."""
    clock: float = 12e6
    """Hz, of the chip's reference, as it truly is."""
    far: float = 3e6
    gain: float = 0.1
    reach: float = 3.0
    """mm."""
    drift: float = 0.0
    """1/K."""
    noise: float = 0.0
    """Hz, standard deviation of a reading."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadCell:
    """A load cell that carries the nozzle, with its HX711 or HX717 at two pins.

    A reading is zero + counts_per_gram·F, where the force F, in g, is stiffness times how deep the nozzle is
    pressed into BED, plus drift·t, plus hum·sin(2·π·hum_hz·t). X, Y, Z and the slopes are axes as of a probe.
    """

    name: str
    dout_pin: str
    sclk_pin: str
    bed: str | None = None
    """None: nothing presses against it."""
    x: str | None = None
    y: str | None = None
    z: str | None = None
    slope_x: str | None = None
    slope_y: str | None = None
    rate: float = 80.0
    """Conversions per second, as it truly is."""
    counts_per_gram: float = 100.0
    zero: float = 0.0
    """Counts without any force."""
    stiffness: float = 4000.0
    """g/mm."""
    drift: float = 0.0
    """g/s."""
    hum: float = 0.0
    """g."""
    hum_hz: float = 50.0
    noise: float = 0.0
    """Counts, standard deviation of a reading."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tmc:
    """The driver CHIP (tmc2208, tmc2209) of a stepper of the same node, on a UART.

    For the axes of its stepper a full step has MICROSTEPS, independent of its registers.
    """

    name: str
    chip: str
    stepper: str
    tx_pin: str
    rx_pin: str
    microsteps: int
    address: int = 0
    free_load: float = 300.0
    """SG_RESULT while the motor is not blocked."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Diag:
    """A pin wired to DIAG of a driver of any node."""

    pin: str
    node: str
    tmc: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Body:
    """A thermal mass."""

    name: str
    capacity: float
    loss: float
    """To the environment."""
    start: float | None = None
    """None: ambient temperature."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Couple:
    """Thermal conductance between two bodies."""

    a: str
    b: str
    conductance: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Heater:
    """A heater: full power while its pin is on, or in proportion to its hardware PWM."""

    name: str
    pin: str
    body: str
    power: float
    inverted: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Fan:
    """A fan: RPM at full duty, reached with a lag; it may have a tachometer."""

    name: str
    pin: str
    inverted: bool = False
    rpm: float = 6000.0
    lag: float = 0.3
    tach_pin: str | None = None
    pulses: float = 2.0
    """Per revolution."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cooling:
    """Cooling of a body by a fan on any node: additional loss at full duty."""

    body: str
    node: str
    fan: str
    conductance: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Beta:
    """A thermistor by its resistance at one temperature and its Beta, below a pull-up resistor."""

    beta: float
    r0: float = 100_000.0
    t0: float = 25.0
    pullup: float = 4700.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Steinhart:
    """A thermistor by the coefficients of Steinhart and Hart, below a pull-up resistor."""

    c1: float
    c2: float
    c3: float
    pullup: float = 4700.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Rtd:
    """A resistance r0·(1 + a·T + b·T²) below a pull-up resistor; by default a PT1000."""

    r0: float = 1000.0
    a: float = 3.9083e-3
    b: float = -5.775e-7
    pullup: float = 4700.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Linear:
    """An amplifier: ZERO + SLOPE·T as a ratio of the converter's full scale."""

    zero: float
    slope: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """At most 64 points of °C (rising) and ratio of the converter's full scale, interpolated linearly."""

    points: tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor:
    """A sensor in a body of any node, with a lag, and with noise in steps of the converter."""

    name: str
    pin: str
    node: str
    """Node of its body."""
    body: str
    curve: Beta | Steinhart | Rtd | Linear | Table
    lag: float = 0.0
    noise: float = 0.0
    """Standard deviation."""
    bits: int = 12


_FIELD_NAMES: Final = {
    "step_pin": "step",
    "dir_pin": "dir",
    "enable_pin": "enable",
    "tach_pin": "tach",
    "control_pin": "control",
    "intb_pin": "intb",
    "dout_pin": "dout",
    "sclk_pin": "sclk",
    "tx_pin": "tx",
    "rx_pin": "rx",
}
"""Names in the text, where they differ from those of the fields."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodePlant:
    """The plant of one node."""

    node: str
    seed: int = 1
    ambient: float = 25.0
    steppers: tuple[Stepper, ...] = ()
    axes: tuple[Axis, ...] = ()
    switches: tuple[Switch, ...] = ()
    beds: tuple[Bed, ...] = ()
    deltas: tuple[Delta, ...] = ()
    probes: tuple[Probe, ...] = ()
    coils: tuple[Coil, ...] = ()
    load_cells: tuple[LoadCell, ...] = ()
    tmcs: tuple[Tmc, ...] = ()
    diags: tuple[Diag, ...] = ()
    bodies: tuple[Body, ...] = ()
    couples: tuple[Couple, ...] = ()
    heaters: tuple[Heater, ...] = ()
    fans: tuple[Fan, ...] = ()
    coolings: tuple[Cooling, ...] = ()
    sensors: tuple[Sensor, ...] = ()

    def text(self) -> str:
        """Return the description as the firmware reads it; CanductorError for an invalid name."""
        return "".join(f"{line}\n" for line in self._lines())

    def write(self, folder: Path) -> Path:
        """Write the description to FOLDER, which all plants of a machine share; return its path."""
        path = folder / f"{self.node}.plant"
        path.write_text(self.text())
        return path

    @property
    def peers(self) -> tuple[str, ...]:
        """Names of the other nodes whose steppers, fans or bodies it uses."""
        named = [term.node for axis in self.axes for term in axis.terms]
        named += [cooling.node for cooling in self.coolings]
        named += [sensor.node for sensor in self.sensors]
        named += [diag.node for diag in self.diags]
        named += [bed.node for bed in self.beds if bed.node is not None]
        return tuple(dict.fromkeys(name for name in named if name != self.node))

    def _lines(self) -> Iterator[str]:
        yield _line("plant", {"node": self.node, "seed": self.seed, "ambient": self.ambient})
        yield from self._parts("stepper", self.steppers)
        for axis in self.axes:
            yield _line("axis", _fields(axis, without=("terms",)))
            for term in axis.terms:
                fields = {"axis": axis.name, "node": self._short(term.node), "stepper": term.stepper}
                yield _line("term", fields | {"mm": term.mm_per_step})
        for kind, parts in (
            *(("switch", self.switches), ("body", self.bodies), ("bed", self.beds)),
            *(("delta", self.deltas), ("probe", self.probes), ("tmc", self.tmcs)),
            *(("diag", self.diags), ("couple", self.couples), ("fan", self.fans)),
            *(("cooling", self.coolings), ("heater", self.heaters), ("coil", self.coils)),
            ("load_cell", self.load_cells),
        ):
            yield from self._parts(kind, parts)
        for sensor in self.sensors:
            curve = {"curve": type(sensor.curve).__name__.lower()} | _fields(sensor.curve, ("points",))
            yield _line("sensor", self._own(_fields(sensor, without=("curve",))) | curve)
            for celsius, ratio in sensor.curve.points if isinstance(sensor.curve, Table) else ():
                yield _line("point", {"sensor": sensor.name, "celsius": celsius, "ratio": ratio})

    def _parts(self, kind: str, parts: Iterable[Any]) -> Iterator[str]:
        for part in parts:
            yield _line(kind, self._own(_fields(part)))

    def _own(self, fields: dict[str, Any]) -> dict[str, Any]:
        return fields | {"node": self._short(fields["node"])} if fields.get("node") else fields

    def _short(self, node: str) -> str:
        return "-" if node == self.node else node


def _fields(part: Any, without: tuple[str, ...] = ()) -> dict[str, Any]:
    names = [field.name for field in dataclasses.fields(part) if field.name not in without]
    return {_FIELD_NAMES.get(name, name): getattr(part, name) for name in names}


def _line(kind: str, fields: dict[str, Any]) -> str:
    words = [f"{name}={_word(name, value)}" for name, value in fields.items() if value is not None]
    return " ".join((kind, *words))


def _word(name: str, value: Any) -> str:
    if isinstance(value, float):
        return repr(value)
    word = str(int(value) if isinstance(value, bool) else value)
    if not word or len(word) > NAME_MAX or len(word.split()) != 1 or not word.isascii():
        raise CanductorError(
            f"the plant of a virtual node cannot have {name} {word!r}; "
            f"give 1 to {NAME_MAX} characters without blanks"
        )
    return word

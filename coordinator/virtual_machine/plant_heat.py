"""The heat of a configured machine: what its heaters warm, which sensors are in it, which fans blow at it.

The bodies are typical ones, whatever the maker. Sensors are computed from data sheets, so that what the
machine reads is compared with something that shares no code with it.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Final

from coordinator.config.file import ConfigFile, RawSection, parse_config
from coordinator.config.model import MachineDescription
from coordinator.config.options import BadValue
from coordinator.config.pins import PinDescription, PinOption, PinRegistry
from coordinator.config.sections.nodes import make_pin_registry
from nodes.support.numbers import read_decimal
from nodes.virtual.plant import (
    Beta,
    Body,
    Cooling,
    Couple,
    Fan,
    Heater,
    Linear,
    Rtd,
    Sensor,
    Steinhart,
    Table,
)

SHARED: Final = "plant"
TABLE_POINTS: Final = 64
WORD_MAX: Final = 50
"""Characters of a section's name; what is added to it has room as well."""
ZERO_C: Final = 273.15
PULLUP_OHM: Final = 4700.0

Curve = Beta | Steinhart | Rtd | Linear | Table


@dataclass(frozen=True, slots=True, kw_only=True)
class HeatSettings:
    """How heat is to be."""

    ambient_c: float = 25.0
    adc_noise: float = 0.5
    """Standard deviation of a sample, in steps of the converter."""
    bits: int = 12
    curves: Mapping[str, Curve] = field(default_factory=dict)
    """Of sensors by their `sensor_type`, before those known here; see `table_of`."""
    hurry: float = 1.0
    """Capacities are divided by this: 10 warms up in a tenth of the time, to where it would anyway."""
    warm_c: Mapping[str, float] = field(default_factory=dict)
    """How warm heated things begin, by the first word of their sections; others are as warm as the air."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Thing:
    """A typical thing that is heated."""

    power: float
    capacity: float
    loss: float
    lag: float
    fan_loss: float = 0.0
    """By the part fan."""
    heater_capacity: float = 0.0
    """Of a heater that is a body of its own, so that its heat comes later; 0: it is none."""
    contact: float = 0.0
    """From the heater to the thing, W/K."""


HOTEND: Final = _Thing(
    power=40.0, capacity=11.0, loss=0.075, lag=1.0, fan_loss=0.03, heater_capacity=2.0, contact=1.5
)
BED: Final = _Thing(power=250.0, capacity=450.0, loss=1.6, lag=2.0)
OTHER: Final = _Thing(power=100.0, capacity=150.0, loss=0.5, lag=2.0)
AIR_CAPACITY: Final = 100.0
"""Of what a sensor without heater hangs in."""
AIR_LOSS: Final = 1.0
COIL_SENSOR: Final = "temperature_probe"
"""First word of the sections of sensors that are in the coil of an eddy current probe."""
COIL_CAPACITY: Final = 400.0
BED_BODY: Final = "heater_bed"
COIL_TO_BED: Final = 1.0
"""W/K: half of what the bed is warmer than the air, in the end."""

_POINTS: Final[Mapping[str, tuple[tuple[float, float], ...]]] = {
    "EPCOS 100K B57560G104F": ((25, 100_000), (150, 1641.9), (250, 226.15)),
    "ATC Semitec 104GT-2": ((20, 126_800), (150, 1360), (300, 80.65)),
    "ATC Semitec 104NT-4-R025H42G": ((25, 100_000), (160, 1074), (300, 82.78)),
    "Generic 3950": ((25, 100_000), (150, 1711), (250, 231)),
    "SliceEngineering 450": ((25, 500_000), (200, 3734), (400, 240)),
    "TDK NTCG104LH104JT1": ((25, 100_000), (50, 31_230), (125, 2066)),
}
"""°C and ohm, from the makers' data sheets."""
_BETAS: Final[Mapping[str, float]] = {
    "Honeywell 100K 135-104LAG-J01": 3974.0,
    "NTC 100K MGB18-104F39050L32": 4100.0,
}
_UNKNOWN_BETA: Final = 3950.0
_PIN: Final = PinOption(name="pin", help="", pullable=True, share=SHARED)


@dataclass(slots=True)
class NodeHeat:
    """What a node's plant has of it."""

    bodies: list[Body] = field(default_factory=list)
    couples: list[Couple] = field(default_factory=list)
    heaters: list[Heater] = field(default_factory=list)
    fans: list[Fan] = field(default_factory=list)
    coolings: list[Cooling] = field(default_factory=list)
    sensors: list[Sensor] = field(default_factory=list)

    def parts(self) -> dict[str, Any]:
        """Return all as the fields of a NodePlant."""
        return {part.name: tuple(getattr(self, part.name)) for part in fields(self)}


def table_of(ratio: Callable[[float], float], low_c: float, high_c: float) -> Table:
    """Return the curve of a sensor by the share of full scale it gives at a temperature, LOW_C to HIGH_C."""
    step_c = (high_c - low_c) / (TABLE_POINTS - 1)
    celsius = [low_c + n * step_c for n in range(TABLE_POINTS)]
    return Table(points=tuple((c, float(ratio(c))) for c in celsius))


def machine_heat(description: MachineDescription, settings: HeatSettings) -> dict[str, NodeHeat]:
    """Return the heat of each node, by the sections of the machine's configuration; raises CanductorError."""
    config = parse_config(description.path)
    heat = {node.name: NodeHeat() for node in description.nodes}
    maker = _Maker(config, make_pin_registry(config, description.nodes), heat, settings)
    for section in config.sections.values():
        maker.add(section)
    maker.join()
    return heat


def steinhart(*points: tuple[float, float], pullup: float = PULLUP_OHM) -> Curve:
    """Return the thermistor through three points (°C, ohm); where none goes, by Beta of the outer two."""
    (t1, r1), (t2, r2), (t3, r3) = sorted(points)
    y1, y2, y3 = (1 / (t + ZERO_C) for t in (t1, t2, t3))
    l1, l2, l3 = (math.log(r) for r in (r1, r2, r3))
    g2, g3 = (y2 - y1) / (l2 - l1), (y3 - y1) / (l3 - l1)
    c3 = (g3 - g2) / (l3 - l2) / (l1 + l2 + l3)
    c2 = g2 - c3 * (l1 * l1 + l1 * l2 + l2 * l2)
    if c3 < 0 or c2 <= 0:
        return Beta(beta=(l1 - l3) / (y1 - y3), r0=r3, t0=t3, pullup=pullup)
    return Steinhart(c1=y1 - c2 * l1 - c3 * l1**3, c2=c2, c3=c3, pullup=pullup)


class _Maker:
    """Makes what each section stands for."""

    def __init__(
        self, config: ConfigFile, pins: PinRegistry, heat: dict[str, NodeHeat], settings: HeatSettings
    ) -> None:
        self._config = config
        self._pins = pins
        self._heat = heat
        self._settings = settings
        self._blown: list[tuple[str, str, float]] = []  # node, body and conductance of the part fan
        self._part_fans: list[tuple[str, str]] = []  # node and name
        self._coils: list[tuple[str, str]] = []  # node and body of those of eddy current probes

    def add(self, section: RawSection) -> None:
        """Take SECTION, if it is one of heat or fans."""
        name = plant_word(section.name)
        if heater_pin := self._pin(section, "heater_pin"):
            self._add_heated(section, name, heater_pin)
        elif "sensor_pin" in section.options:
            self._add_sensor(section, name, None)
        if _is_fan(section) and (pin := self._pin(section, "pin")):
            self._add_fan(section, name, pin)

    def join(self) -> None:
        """Let part fans blow at hotends, and the bed warm coils; to be called when all is there."""
        for node, coil in self._coils:
            if any(body.name == BED_BODY for body in self._heat[node].bodies):
                self._heat[node].couples.append(Couple(a=BED_BODY, b=coil, conductance=COIL_TO_BED))
        for node, body, conductance in self._blown:
            self._heat[node].coolings.extend(
                Cooling(body=body, node=at, fan=fan, conductance=conductance) for at, fan in self._part_fans
            )

    def _add_heated(self, section: RawSection, name: str, pin: PinDescription) -> None:
        thing = _thing(section)
        heat, hurry = self._heat[pin.node], self._settings.hurry
        warm_c = self._settings.warm_c.get(section.kind)
        heat.bodies.append(Body(name=name, capacity=thing.capacity / hurry, loss=thing.loss, start=warm_c))
        into = name
        if thing.heater_capacity:
            into = f"{name}_heater"
            heat.bodies.append(
                Body(name=into, capacity=thing.heater_capacity / hurry, loss=0.0, start=warm_c)
            )
            heat.couples.append(Couple(a=into, b=name, conductance=thing.contact))
        heat.heaters.append(
            Heater(name=name, pin=pin.name, body=into, power=thing.power, inverted=pin.invert)
        )
        if thing.fan_loss:
            self._blown.append((pin.node, name, thing.fan_loss))
        self._add_sensor(section, name, pin.node)

    def _add_sensor(self, section: RawSection, name: str, body_node: str | None) -> None:
        pin = self._pin(section, "sensor_pin")
        if pin is None:
            return
        if body_node is None:
            body_node = pin.node
            capacity = AIR_CAPACITY
            if section.kind == COIL_SENSOR:
                capacity = COIL_CAPACITY / self._settings.hurry
                self._coils.append((pin.node, name))
            self._heat[pin.node].bodies.append(Body(name=name, capacity=capacity, loss=AIR_LOSS))
        self._heat[pin.node].sensors.append(
            Sensor(
                name=name,
                pin=pin.name,
                node=body_node,
                body=name,
                curve=self._curve(section),
                lag=_thing(section).lag / self._settings.hurry,
                noise=self._settings.adc_noise,
                bits=self._settings.bits,
            )
        )

    def _add_fan(self, section: RawSection, name: str, pin: PinDescription) -> None:
        tach = self._pin(section, "tachometer_pin")
        tach_pin = tach.name if tach is not None and tach.node == pin.node else None
        pulses = _number(section, "tachometer_ppr", 2.0)
        self._heat[pin.node].fans.append(
            Fan(name=name, pin=pin.name, inverted=pin.invert, tach_pin=tach_pin, pulses=pulses)
        )
        if section.name == "fan":
            self._part_fans.append((pin.node, name))

    def _pin(self, section: RawSection, option: str) -> PinDescription | None:
        """Return the pin that OPTION names; None where it is not given, or no pin of a node."""
        if option not in section.options:
            return None
        try:
            pin = _PIN.parse(section.options[option].value)
        except BadValue:
            return None  # who reads the section says what is wrong
        if pin.node not in self._heat:
            return None  # such as a driver's own pin
        given = PinOption(name=option, help="", pullable=True, share=SHARED)
        return self._pins.claim(pin, given, section)

    def _curve(self, section: RawSection) -> Curve:
        kind = _text(section, "sensor_type")
        pullup = _number(section, "pullup_resistor", PULLUP_OHM)
        if kind in self._settings.curves:
            return self._settings.curves[kind]
        own = self._config.sections.get(f"thermistor {kind}")
        if own is not None:
            return _own_curve(own, pullup)
        if kind in _POINTS:
            return steinhart(*_POINTS[kind], pullup=pullup)
        if kind == "PT1000":
            return Rtd(pullup=pullup)
        return Beta(beta=_BETAS.get(kind, _UNKNOWN_BETA), pullup=pullup)


def _own_curve(section: RawSection, pullup: float) -> Curve:
    """Return the thermistor that a section [thermistor NAME] describes."""
    points = list(_points(section))
    if len(points) == 3:
        return steinhart(*points, pullup=pullup)
    t0, r0 = points[0] if points else (25.0, 100_000.0)
    return Beta(beta=_number(section, "beta", _UNKNOWN_BETA), r0=r0, t0=t0, pullup=pullup)


def _points(section: RawSection) -> Iterator[tuple[float, float]]:
    for n in range(1, 4):
        celsius, ohm = _number(section, f"temperature{n}", -300.0), _number(section, f"resistance{n}", 0.0)
        if celsius > -ZERO_C and ohm > 0:
            yield celsius, ohm


def _thing(section: RawSection) -> _Thing:
    return HOTEND if section.kind.startswith("extruder") else BED if section.kind == "heater_bed" else OTHER


def _is_fan(section: RawSection) -> bool:
    return section.kind == "fan" or section.kind.endswith("_fan") or section.kind == "fan_generic"


def _text(section: RawSection, option: str) -> str:
    return section.options[option].value if option in section.options else ""


def _number(section: RawSection, option: str, otherwise: float) -> float:
    """Return a number; OTHERWISE where it is none: who reads the section says what is wrong."""
    value = read_decimal(_text(section, option) or "")
    return otherwise if value is None else value


def plant_word(name: str) -> str:
    """Return a section's name as a word of a plant."""
    return "".join(c if c.isascii() and c.isalnum() else "_" for c in name)[:WORD_MAX]

"""Generic cartesian: [carriage NAME] for each axis, [stepper NAME] for each motor that moves carriages."""

import re
from dataclasses import dataclass, replace
from typing import TypeVar

from coordinator.kinematics.base import StepFunction
from coordinator.kinematics.generic_cartesian import GenericCartesian
from coordinator.machine.config_file import RawSection
from coordinator.machine.frame import Frame, box_of, home_of
from coordinator.machine.model import RailDescription, StepperDescription
from coordinator.machine.options import BadValue, ChoiceOption, Option, SectionReader, SectionSpec, TextOption
from coordinator.machine.problem import ConfigError, Place, nearest, shown
from coordinator.machine.read_dual import SAFE_DISTANCE, describe_dual, park
from coordinator.machine.read_homing import ENDSTOP_PIN, HOMING, WAITING, read_endstop, read_homing
from coordinator.machine.read_rails import RANGE, read_range
from coordinator.machine.read_steppers import MOTOR, read_stepper
from coordinator.machine.reading import Reading
from coordinator.machine.well_known import LATER_STEPPER_OPTIONS
from nodes.records import record

AXIS = ChoiceOption(
    name="axis", help="the axis of the carriage; by default its name, if that is one", choices=("x", "y", "z")
)
CARRIAGE = SectionSpec(
    help="A carriage of a generic_cartesian machine: an axis' range and homing",
    options=(AXIS, *RANGE, *HOMING),
    later=LATER_STEPPER_OPTIONS,
)
PRIMARY_CARRIAGE = TextOption(
    name="primary_carriage",
    help="the [carriage NAME] beside which it runs",
    pattern=r"\S+",
    pattern_rule="the name of a carriage",
)
EXTRA_CARRIAGE = SectionSpec(
    help="A second endstop of a carriage, such as the other side of a gantry; does not act yet",
    options=(PRIMARY_CARRIAGE, ENDSTOP_PIN),
)
DUAL_CARRIAGE = SectionSpec(
    help="The second carriage on the axis of another one (IDEX) of a generic_cartesian machine",
    options=(PRIMARY_CARRIAGE, SAFE_DISTANCE, *RANGE, *HOMING),
    later=LATER_STEPPER_OPTIONS,
)

T = TypeVar("T")
Sum = tuple[tuple[str, float], ...]
_TERM = re.compile(r"([+-])(?:(\d+\.?\d*|\.\d+)\*)?([A-Za-z_]\w*)", re.ASCII)
_MAX_SUM_CHARS = 500
_MAX_FACTOR = 1000.0


class SumOption(Option[Sum]):
    """A sum of carriages with factors: ``carriage_x+0.5*carriage_y``."""

    def parse(self, text: str) -> Sum:
        """Return names and factors."""
        packed = "".join(text.split())
        packed = packed if packed[:1] in {"+", "-"} else f"+{packed}"
        if len(packed) > _MAX_SUM_CHARS or _TERM.sub("", packed):
            raise BadValue
        terms: dict[str, float] = {}
        for sign, factor, name in _TERM.findall(packed):
            value = float(factor or 1) * (-1 if sign == "-" else 1)
            if name in terms or not 1 / _MAX_FACTOR <= abs(value) <= _MAX_FACTOR:
                raise BadValue
            terms[name] = value
        return tuple(terms.items())

    def rule(self) -> str:
        """Return the values allowed."""
        return "a sum of different carriages as in carriage_x, x-y or carriage_x+0.5*carriage_y"


CARRIAGES = SumOption(name="carriages", help="what the stepper's way is, per way of the carriages")
STEPPER = SectionSpec(help="A motor of a generic_cartesian machine", options=(*MOTOR, CARRIAGES))


@record
class _Motor:
    """A stepper with its way per mm of each axis, and the axis' second carriage if it moves that."""

    stepper: StepperDescription
    second: str = ""
    """Name of the second carriage that it moves; empty: it moves first ones."""


@dataclass(slots=True)
class _Carriages:
    """By name; the axes of RailDescription say where they run."""

    first: dict[str, RailDescription]
    second: dict[str, tuple[RailDescription, SectionReader]]

    def range_options(self) -> tuple[str, str, str]:
        """Return which options say how far X, Y and Z may go."""
        section = {rail.axis: f"[carriage {name}]" for name, rail in self.first.items()}
        x, y, z = (f"position_min and position_max of {section[axis]}" for axis in "xyz")
        return (x, y, z)

    def find(self, reader: SectionReader, option: Option[T], name: str) -> RailDescription:
        """Return a first or second carriage; raises ConfigError."""
        if name in self.first:
            return self.first[name]
        if name in self.second:
            return self.second[name][0]
        names = (*self.first, *self.second)
        hint = nearest(name, names) or f"; there is {', '.join(names)}"
        raise reader.bad(option, f"but there is no carriage {shown(name)}{hint}")


def read_generic(reading: Reading, _printer: SectionReader) -> Frame:
    """Return the frame of a generic cartesian machine; raises ConfigError."""
    by_axis: dict[str, RailDescription] = {}
    carriages = _Carriages({}, {})
    for section in reading.named("carriage"):
        rail = _read_carriage(reading, section)
        other = by_axis.setdefault(rail.axis, rail)
        if other is not rail:
            raise ConfigError(
                rail.place,
                f"[{section.name}] is on axis {rail.axis} like the carriage of {other.place}; make it"
                f" [dual_carriage {section.instance}] or give it another axis",
            )
        carriages.first[section.instance] = rail
    for axis in "xyz":
        if axis not in by_axis:
            raise ConfigError(
                Place(reading.config.path, 0),
                f"no [carriage NAME] is on axis {axis}; add one: every axis needs it",
            )
    _read_further_carriages(reading, carriages)
    motors = [_read_motor(reading, section, carriages) for section in reading.named("stepper")]
    return _frame(reading, (by_axis["x"], by_axis["y"], by_axis["z"]), carriages, motors)


def _read_carriage(reading: Reading, section: RawSection) -> RailDescription:
    reader = SectionReader(section, CARRIAGE)
    axis = reader.find(AXIS) or (section.instance if section.instance in "xyz" else reader.get(AXIS))
    low, high = read_range(reader)
    rail = RailDescription(axis, (), low, high, read_homing(reader, low, high, reading.pins), section.place)
    reading.finish(reader)
    return rail


def _read_further_carriages(reading: Reading, carriages: _Carriages) -> None:
    for section in reading.named("dual_carriage"):
        reader = SectionReader(section, DUAL_CARRIAGE)
        first = _primary(reader, carriages)
        if carriages.second or first.axis == "z":
            raise reader.bad(PRIMARY_CARRIAGE, "but there can be one second carriage, on x or y; remove it")
        low, high = read_range(reader)
        homing = read_homing(reader, low, high, reading.pins)
        rail = RailDescription(first.axis, (), low, high, homing, section.place)
        carriages.second[section.instance] = (rail, reader)
    for section in reading.named("extra_carriage"):
        reader = SectionReader(section, EXTRA_CARRIAGE)
        _primary(reader, carriages)
        read_endstop(reader, reading.pins)
        reading.finish(reader, waiting=WAITING)


def _primary(reader: SectionReader, carriages: _Carriages) -> RailDescription:
    return carriages.find(reader, PRIMARY_CARRIAGE, reader.get(PRIMARY_CARRIAGE))


def _read_motor(reading: Reading, section: RawSection, carriages: _Carriages) -> _Motor:
    reader = SectionReader(section, STEPPER)
    weights = [0.0, 0.0, 0.0, 0.0]
    second = ""
    for name, factor in reader.get(CARRIAGES):
        axis = "xyz".index(carriages.find(reader, CARRIAGES, name).axis)
        if weights[axis]:
            raise reader.bad(CARRIAGES, f"which takes both carriages of axis {'xyz'[axis]}; keep one of them")
        weights[axis] = factor
        second = name if name in carriages.second else second
    function = StepFunction(weights=(weights[0], weights[1], weights[2], weights[3]))
    stepper = read_stepper(reader, function, reading.pins, name=section.instance)
    reading.finish(reader)
    return _Motor(stepper, second)


def _frame(
    reading: Reading,
    axes: tuple[RailDescription, RailDescription, RailDescription],
    carriages: _Carriages,
    motors: list[_Motor],
) -> Frame:
    own = tuple(motor.stepper for motor in motors if not motor.second)
    kinematics = GenericCartesian(tuple((s.name, s.weights[:3]) for s in own), box_of(*axes))
    if not kinematics.independent:
        raise ConfigError(
            Place(reading.config.path, 0),
            "the [stepper NAME] sections do not move x, y and z independently; correct their 'carriages'",
        )
    x, y, z = (replace(rail, steppers=_movers(own, axis)) for axis, rail in enumerate(axes))
    frame = Frame(
        kinematics,
        (x, y, z),
        (home_of(x), home_of(y), home_of(z)),
        own,
        range_options=carriages.range_options(),
    )
    for name, (rail, reader) in carriages.second.items():
        axis = "xyz".index(rail.axis)
        theirs = tuple(motor.stepper for motor in motors if motor.second == name)
        if not theirs:
            raise ConfigError(
                rail.place, f"no [stepper NAME] moves carriage '{name}'; name it in 'carriages' of one"
            )
        dual = describe_dual(reader, axis, (frame.rails[axis], frame.rails[axis].steppers), (rail, theirs))
        reading.finish(reader, waiting=WAITING if rail.homing.waits else ())
        frame = park(frame, dual, theirs, reader.name)
    return frame


def _movers(steppers: tuple[StepperDescription, ...], axis: int) -> tuple[StepperDescription, ...]:
    return tuple(stepper for stepper in steppers if stepper.weights[axis])

"""Generic cartesian: [carriage NAME] for each axis, [stepper NAME] for each motor that moves carriages."""

import re
from dataclasses import dataclass, replace
from typing import TypeVar

from coordinator.config.errors import ConfigError, Place
from coordinator.config.file import RawSection
from coordinator.config.model import RailDescription, StepperDescription, Unsupported
from coordinator.config.options import BadValue, ChoiceOption, Option, SectionReader, SectionSpec, TextOption
from coordinator.config.pins import PinDescription
from coordinator.config.sections.homing import ENDSTOP_PIN, HOMING, WAITING, read_endstop, read_homing
from coordinator.config.sections.kinematics.dual_carriage import SAFE_DISTANCE, describe_dual, park
from coordinator.config.sections.kinematics.frame import Frame, KinematicsKind, box_of, home_of
from coordinator.config.sections.rails import RANGE, read_range
from coordinator.config.sections.reading import Reading, SecondEndstop
from coordinator.config.sections.steppers import MOTOR, read_stepper
from coordinator.config.unsupported import UNSUPPORTED_STEPPER_OPTIONS
from coordinator.kinematics.base import StepFunction
from coordinator.kinematics.generic_cartesian import GenericCartesian
from coordinator.support.quoting import nearest_or_all, shown

AXIS = ChoiceOption(
    name="axis", help="the axis of the carriage; by default its name, if that is one", choices=("x", "y", "z")
)
CARRIAGE = SectionSpec(
    help="A carriage of a generic_cartesian machine: an axis' range and homing",
    options=(AXIS, *RANGE, *HOMING),
    unsupported=UNSUPPORTED_STEPPER_OPTIONS,
)
PRIMARY_CARRIAGE = TextOption(
    name="primary_carriage",
    help="the [carriage NAME] on whose axis it runs",
    pattern=r"\S+",
    pattern_rule="the name of a carriage",
)
EXTRA_CARRIAGE = SectionSpec(
    help="A second endstop of a carriage, such as the other side of a gantry; it acts where one stepper has"
    " that side to itself, and no other moves the axis with another one",
    options=(PRIMARY_CARRIAGE, ENDSTOP_PIN),
)
DUAL_CARRIAGE = SectionSpec(
    help="The second carriage on the axis of another one (IDEX) of a generic_cartesian machine",
    options=(PRIMARY_CARRIAGE, SAFE_DISTANCE, *RANGE, *HOMING),
    unsupported=UNSUPPORTED_STEPPER_OPTIONS,
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

    def setting(self, text: str, value: Sum) -> object:
        """Return the text."""
        del value
        return text

    def rule(self) -> str:
        """Return the values allowed."""
        return "a sum of different carriages as in carriage_x, x-y or carriage_x+0.5*carriage_y"

    def stand_in(self) -> Sum:
        """Return no carriage."""
        return ()


CARRIAGES = SumOption(name="carriages", help="what the stepper's way is, per way of the carriages")
STEPPER = SectionSpec(help="A motor of a generic_cartesian machine", options=(*MOTOR, CARRIAGES))


@dataclass(frozen=True, slots=True)
class _Motor:
    """A stepper with its way per mm of each axis, and the axis' second carriage if it moves that."""

    stepper: StepperDescription
    second: tuple[str, ...] = ()
    """Names of the second carriages that it moves; none: it moves first ones."""
    extra: tuple[str, ...] = ()
    """Names of the extra carriages that it moves."""


@dataclass(slots=True)
class _Carriages:
    """By name; the axes of RailDescription say where they run."""

    first: dict[str, RailDescription]
    second: dict[str, tuple[RailDescription, SectionReader]]
    extra: dict[str, RailDescription]
    """The first carriage of each."""

    def range_options(self) -> tuple[str, str, str]:
        """Return which options say how far X, Y and Z may go."""
        section = {rail.axis: f"[carriage {name}]" for name, rail in self.first.items()}
        x, y, z = (f"position_min and position_max of {section[axis]}" for axis in "xyz")
        return (x, y, z)

    def axes(self) -> dict[str, str]:
        """Return the axis of each carriage by name."""
        rails = {**self.first, **{name: rail for name, (rail, _) in self.second.items()}, **self.extra}
        return {name: rail.axis for name, rail in rails.items()}

    def find(self, reader: SectionReader, option: Option[T], name: str) -> RailDescription:
        """Return a first or second carriage; raises ConfigError."""
        if name in self.first:
            return self.first[name]
        if name in self.second:
            return self.second[name][0]
        if name in self.extra:
            return self.extra[name]
        names = (*self.first, *self.second, *self.extra)
        hint = nearest_or_all(name, names)
        raise reader.bad(option, f"but there is no carriage {shown(name)}{hint}")


def read_generic(reading: Reading, _printer: SectionReader) -> Frame:
    """Return the frame of a generic cartesian machine; raises ConfigError."""
    by_axis: dict[str, RailDescription] = {}
    carriages = _Carriages({}, {}, {})
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
    ends = _read_extra_carriages(reading, carriages)
    motors = [_read_motor(reading, section, carriages) for section in reading.named("stepper")]
    _note_second_endstops(reading, ends, motors)
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
        if first.axis == "z" or any(rail.axis == first.axis for rail, _ in carriages.second.values()):
            raise reader.bad(
                PRIMARY_CARRIAGE, "but x and y can have one second carriage each, and z none; remove it"
            )
        low, high = read_range(reader)
        homing = read_homing(reader, low, high, reading.pins)
        rail = RailDescription(first.axis, (), low, high, homing, section.place)
        carriages.second[section.instance] = (rail, reader)


_End = tuple[Place, PinDescription | None, str]
"""Of an extra carriage: where it stands, its endstop's pin, and the virtual endstop that it is of."""


def _read_extra_carriages(reading: Reading, carriages: _Carriages) -> dict[str, _End]:
    """Return the endstop of each by its name; raises ConfigError."""
    ends: dict[str, _End] = {}
    for section in reading.named("extra_carriage"):
        reader = SectionReader(section, EXTRA_CARRIAGE)
        carriages.extra[section.instance] = _primary(reader, carriages)
        ends[section.instance] = (section.place, *read_endstop(reader, reading.pins))
        reading.finish(reader)
    return ends


def _note_second_endstops(reading: Reading, ends: dict[str, _End], motors: list[_Motor]) -> None:
    """Note which stepper has an extra carriage to itself; those that can be of no stepper do not act."""
    for name, (place, pin, virtual) in ends.items():
        section = f"extra_carriage {name}"
        movers = [motor.stepper.name for motor in motors if name in motor.extra]
        if pin is None or len(movers) != 1:
            reading.unsupported.append(Unsupported(section, place, (ENDSTOP_PIN.name,)))
        else:
            reading.second_endstops[movers[0]] = SecondEndstop(section, place, pin, virtual)


def _primary(reader: SectionReader, carriages: _Carriages) -> RailDescription:
    return carriages.find(reader, PRIMARY_CARRIAGE, reader.get(PRIMARY_CARRIAGE))


def _read_motor(reading: Reading, section: RawSection, carriages: _Carriages) -> _Motor:
    reader = SectionReader(section, STEPPER)
    weights = [0.0, 0.0, 0.0, 0.0]
    second, extra = [], []
    for name, factor in reader.get(CARRIAGES):
        axis = "xyz".index(carriages.find(reader, CARRIAGES, name).axis)
        if weights[axis]:
            raise reader.bad(CARRIAGES, f"which takes both carriages of axis {'xyz'[axis]}; keep one of them")
        weights[axis] = factor
        second += [name] if name in carriages.second else []
        extra += [name] if name in carriages.extra else []
    function = StepFunction(weights=(weights[0], weights[1], weights[2], weights[3]))
    stepper = read_stepper(reader, function, reading.pins, name=section.instance)
    reading.finish(reader)
    return _Motor(stepper, tuple(second), tuple(extra))


def _frame(
    reading: Reading,
    axes: tuple[RailDescription, RailDescription, RailDescription],
    carriages: _Carriages,
    motors: list[_Motor],
) -> Frame:
    own = tuple(motor.stepper for motor in motors if not motor.second)
    runs_on = tuple((name, "xyz".index(axis)) for name, axis in carriages.axes().items())
    kinematics = GenericCartesian(tuple((s.name, s.weights[:3]) for s in own), box_of(*axes), runs_on)
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
    if len(carriages.second) > 1:
        return _without_second(reading, frame, carriages)
    for name, (rail, reader) in carriages.second.items():
        axis = "xyz".index(rail.axis)
        theirs = tuple(motor.stepper for motor in motors if name in motor.second)
        if not theirs:
            raise ConfigError(
                rail.place, f"no [stepper NAME] moves carriage '{name}'; name it in 'carriages' of one"
            )
        first = next(each for each, other in carriages.first.items() if other.axis == rail.axis)
        names = (first, name)
        dual = describe_dual(
            reader, axis, (frame.rails[axis], frame.rails[axis].steppers), (rail, theirs), names
        )
        reading.finish(reader, waiting=WAITING if rail.homing.waits else ())
        frame = park(frame, dual, theirs, reader.name)
    return frame


def _without_second(reading: Reading, frame: Frame, carriages: _Carriages) -> Frame:
    """Return FRAME without its second carriages: two are not supported yet. Their axes cannot be homed."""
    rails = {rail.axis: rail for rail in frame.rails}
    for second, reader in carriages.second.values():
        reader.find(SAFE_DISTANCE)
        reading.finish(reader)
        why = (
            "second carriages on x and y at once are not supported yet, and"
            f" [{reader.name}] may be in the way"
        )
        reading.unsupported.append(Unsupported(reader.name, second.place, (), why))
        first = rails[second.axis]
        rails[second.axis] = replace(first, homing=replace(first.homing, refused=f"{why} ({second.place})"))
    return replace(frame, rails=(rails["x"], rails["y"], rails["z"]))


def _movers(steppers: tuple[StepperDescription, ...], axis: int) -> tuple[StepperDescription, ...]:
    return tuple(stepper for stepper in steppers if stepper.weights[axis])


GENERIC_CARTESIAN = KinematicsKind(
    GenericCartesian,
    read_generic,
    reference={
        "[carriage NAME]": CARRIAGE,
        "[stepper NAME]": STEPPER,
        "[extra_carriage NAME]": EXTRA_CARRIAGE,
        "[dual_carriage NAME]": DUAL_CARRIAGE,
    },
)

"""The machine as the configuration describes it: frozen, checked, ready to be built."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum

from coordinator.config.errors import Place
from coordinator.config.file import RawSection
from coordinator.config.pins import PinDescription, PinRegistry
from coordinator.config.saved import ConfigSource
from coordinator.kinematics.base import Kinematics, Point, StepFunction, Weights
from coordinator.kinematics.dual_carriage import DualCarriage
from coordinator.kinematics.extruder import ExtruderMotion
from coordinator.motion.specs import MotionLimits
from nodes.node.board_reset import ResetMethod


@dataclass(frozen=True, slots=True)
class CanConnection:
    """A node on a CAN bus."""

    uuid: str
    """12 lower-case hex digits."""
    interface: str
    """``can0`` (SocketCAN), ``virtual:PATH`` or ``INTERFACE:CHANNEL`` in python-can's words."""
    place: Place

    @property
    def address(self) -> str:
        """By which the node is known again."""
        return f"can {self.uuid}"


@dataclass(frozen=True, slots=True)
class UartConnection:
    """A node on a serial line."""

    path: str
    baud: int
    restart_method: ResetMethod
    place: Place

    @property
    def address(self) -> str:
        """By which the node is known again."""
        return f"serial {self.path}"


class NodePolicy(Enum):
    """What happens to the machine when a node is lost, shuts down or restarts; the value is its word."""

    FATAL = "fatal"
    """All nodes are stopped."""
    PAUSE = "pause"
    """The job waits at standstill until the node is back."""
    OPTIONAL = "optional"
    """The node's features are off until it is back; it may even be absent at start."""


@dataclass(frozen=True, slots=True)
class NodeDescription:
    """One micro-controller; ``mcu`` is the primary whose clock is print time."""

    name: str
    connection: CanConnection | UartConnection
    place: Place
    policy: NodePolicy
    policy_place: Place
    """Where the policy is given; the section where it is not."""


@dataclass(frozen=True, slots=True)
class StepperDescription:
    """One motor driver."""

    name: str
    """The section's name: stepper_x, stepper_z1, extruder, or NAME of [stepper NAME]."""
    step_pin: PinDescription
    dir_pin: PinDescription
    """Inverted: the pin is high for a step in negative direction."""
    enable_pin: PinDescription | None
    function: StepFunction
    """How its position follows from the axes."""
    step_distance: float
    """mm per step; rad where the position is an angle."""
    rotation_distance: float
    """mm (or rad) per turn of the output after the gears."""
    full_steps_per_rotation: int
    microsteps: int
    gear_ratio: float
    """Turns of the motor per turn of the output."""
    step_pulse_s: float
    """Shortest high time of the step pin; 0: the driver steps on both edges."""
    place: Place
    unpowered: str = ""
    """Why its driver cannot be switched on yet, though it has an enable pin; empty: it can."""

    @property
    def node(self) -> str:
        """The node that drives it."""
        return self.step_pin.node

    @property
    def weights(self) -> Weights:
        """Of a stepper whose position in mm is the sum of weights[i] * axis[i] over X Y Z E; else zeros."""
        return self.function.weights


@dataclass(frozen=True, slots=True)
class HomingDescription:
    """How a rail finds its origin. Without an endstop on a pin G28 takes it as home."""

    endstop_pin: PinDescription | None = None
    virtual_endstop: str = ""
    """Such as ``tmc2209_stepper_x:virtual_endstop``, whose pin is ``endstop_pin``, or one that no module
    offers yet (``probe:z_virtual_endstop``), without pin; empty where the endstop is a switch."""
    position_endstop: float | None = None
    """mm; None with a virtual endstop that knows its own position, or without endstop. Of a tower or an arm:
    Z of the head, in the middle, when the endstop switches."""
    speed: float = 5.0
    """mm/s."""
    second_speed: float = 2.5
    """mm/s of the second approach."""
    retract_distance: float = 5.0
    """mm; 0: no second approach."""
    retract_speed: float = 5.0
    positive_dir: bool = False
    """Whether the endstop stands at the upper end."""
    accel: float | None = None
    """mm/s² of all that; None: as fast as the axis may."""
    refused: str = ""
    """Why G28 must not move it, whatever its endstop; empty: it may."""

    @property
    def by_probe(self) -> bool:
        """Whether its endstop is the probe, which acts."""
        return self.endstop_pin is not None and self.virtual_endstop == PROBE_ENDSTOP

    @property
    def is_sensorless(self) -> bool:
        """Whether a stall of the motor is the endstop."""
        return self.virtual_endstop.startswith("tmc")

    @property
    def waits(self) -> bool:
        """Whether its endstop is one that no module offers yet."""
        return self.endstop_pin is None and bool(self.virtual_endstop)


NO_ENDSTOP = HomingDescription()
PROBE_ENDSTOP = "probe:z_virtual_endstop"
"""The virtual endstop of Z that is the probe."""


SECOND_CARRIAGE = "dual_carriage"


@dataclass(frozen=True, slots=True)
class RailDescription:
    """What is homed as one: an axis, tower, arm or carriage with its steppers."""

    axis: str
    """x, y or z; else the rail's name in its kinematics."""
    steppers: tuple[StepperDescription, ...]
    position_min: float | None
    """mm; None where the kinematics says how far the rail may go."""
    position_max: float | None
    homing: HomingDescription
    place: Place
    second_endstops: tuple[tuple[str, PinDescription, str], ...] = ()
    """Further steppers with an endstop of their own: name, pin, and the virtual endstop that it is of."""

    @property
    def pieces(self) -> "tuple[RailDescription, ...]":
        """What stops by itself: this rail, or what of it has an endstop of its own, as rails."""
        own = {name: (pin, virtual) for name, pin, virtual in self.second_endstops}
        first = replace(
            self, steppers=tuple(s for s in self.steppers if s.name not in own), second_endstops=()
        )
        others = (
            replace(
                self,
                axis=stepper.name.removeprefix("stepper_"),
                steppers=(stepper,),
                homing=replace(
                    self.homing, endstop_pin=own[stepper.name][0], virtual_endstop=own[stepper.name][1]
                ),
                place=stepper.place,
                second_endstops=(),
            )
            for stepper in self.steppers
            if stepper.name in own
        )
        return (first, *others) if own else (self,)


@dataclass(frozen=True, slots=True)
class ProbeDescription:
    """The probe, and what stops when it triggers."""

    rail: RailDescription
    """Whose endstop it is: Z, or else one of its own with the name ``probe``."""
    offset: Point
    """From the nozzle: X, Y, and how high that is above the bed when it triggers, mm."""
    section: str
    """Its section: ``bltouch``."""


@dataclass(frozen=True, slots=True)
class ExtruderDescription:
    """One extruder's mechanics."""

    name: str
    """extruder, extruder1, …"""
    stepper: StepperDescription
    nozzle_diameter: float
    """mm."""
    filament_diameter: float
    """mm."""
    pressure_advance: float
    """s: mm of filament pushed ahead per mm/s."""
    smooth_time_s: float
    """Width of the window over which the advance is spread; 0: no advance."""
    limits: MotionLimits
    """Of the machine while it prints with this extruder."""


@dataclass(frozen=True, slots=True)
class ExtruderStepperDescription:
    """A further stepper that moves filament along with an extruder."""

    name: str
    """As in [extruder_stepper NAME]."""
    stepper: StepperDescription
    extruder: str
    """Name of the extruder whose motion it follows at start; empty: none."""


@dataclass(frozen=True, slots=True)
class DualCarriageDescription:
    """Two carriages on one axis."""

    rails: tuple[RailDescription, RailDescription]
    """The second is parked at start."""
    carriages: "DualCarriage"


@dataclass(frozen=True, slots=True)
class ShaperDescription:
    """How one axis is shaped from the start."""

    axis: str
    """x, y or z."""
    kind: str
    """zv, mzv, zvd, ei, 2hump_ei or 3hump_ei."""
    frequency_hz: float
    damping_ratio: float
    place: Place


@dataclass(frozen=True, slots=True)
class AxisTablesDescription:
    """That axes may have compensation tables, which nodes of this project's firmware keep too."""

    points: int
    """Room of each table."""
    place: Place


@dataclass(frozen=True, slots=True)
class ModuleSection:
    """A section that modules read."""

    section: RawSection
    whole: bool
    """Whether it belongs to one module; else modules read further options of a section read elsewhere."""


@dataclass(frozen=True, slots=True)
class ModuleSections:
    """What the modules of a machine are built from each time it starts (modules/module_set.py)."""

    sections: tuple[ModuleSection, ...]
    """In the order of the file."""
    pins: PinRegistry
    """As the machine's own sections left it."""
    config: Mapping[str, Mapping[str, str]]
    """The configuration as text: options by section."""
    settings: Mapping[str, Mapping[str, object]]
    """As it was read: values and defaults."""


@dataclass(frozen=True, slots=True)
class Unsupported:
    """A known section or options that no module supports yet; they are ignored."""

    section: str
    place: Place
    options: tuple[str, ...]
    """Their names; empty: the whole section."""
    reason: str = ""
    """What it depends on that does not act; empty: it has no module."""

    def __str__(self) -> str:
        what = f"{', '.join(self.options)} of [{self.section}]" if self.options else f"[{self.section}]"
        return f"{self.place}: {what}: not supported yet, ignored" + (self.reason and f": {self.reason}")


@dataclass(frozen=True, slots=True)
class MachineDescription:
    """Everything the configuration says about the machine."""

    path: str
    nodes: tuple[NodeDescription, ...]
    """The primary first, then in the order of the file."""
    kinematics: Kinematics
    limits: MotionLimits
    """Of the first extruder."""
    rails: tuple[RailDescription, ...]
    """X Y Z, or as the kinematics names them; of a corexy the rail x has the motor that moves x + y."""
    motors: tuple[StepperDescription, ...]
    """Steppers of the head: those of the rails in order, or of their own where rails share them."""
    home: Point
    """Where the head stands after G28."""
    dual_carriage: DualCarriageDescription | None
    extruders: tuple[ExtruderDescription, ...]
    """By number."""
    extruder_steppers: tuple[ExtruderStepperDescription, ...]
    shapers: tuple[ShaperDescription, ...]
    modules: ModuleSections
    unsupported: tuple[Unsupported, ...]
    notes: tuple[str, ...]
    """Sentences about what has no effect."""
    axis_tables: AxisTablesDescription | None = None
    """None: axes have no tables."""
    probe: ProbeDescription | None = None
    source: ConfigSource | None = None
    """The file, for what is saved into it; None: there is none."""

    def with_weights(self, changed: Mapping[str, Weights]) -> "MachineDescription":
        """Return the machine with motors (by name) that are other sums of the axes; no second carriages."""

        def motors(steppers: tuple[StepperDescription, ...]) -> tuple[StepperDescription, ...]:
            return tuple(
                replace(stepper, function=StepFunction(weights=changed[stepper.name]))
                if stepper.name in changed
                else stepper
                for stepper in steppers
            )

        changed_motors = motors(self.motors)
        return replace(
            self,
            motors=changed_motors,
            rails=tuple(replace(rail, steppers=motors(rail.steppers)) for rail in self.rails),
            kinematics=self.kinematics.with_motors(
                tuple((motor.name, motor.weights[:3]) for motor in changed_motors)
            ),
        )

    @property
    def second_carriage(self) -> RailDescription | None:
        """The rail of the second carriage, by a name that no axis has."""
        if self.dual_carriage is None:
            return None
        return replace(self.dual_carriage.rails[1], axis=SECOND_CARRIAGE)

    @property
    def stops(self) -> tuple[RailDescription, ...]:
        """All that has an endstop of its own on a pin: rails, pieces of rails, second carriage, probe."""
        second = self.second_carriage
        pieces = (piece for rail in self.rails for piece in rail.pieces)
        found = [*pieces, *(() if second is None else (second,))]
        if self.probe is not None and self.probe.rail.axis not in (rail.axis for rail in self.rails):
            found.append(self.probe.rail)
        return tuple(rail for rail in found if rail.homing.endstop_pin is not None)

    @property
    def homed_position(self) -> dict[str, float]:
        """Where each axis (X, Y, Z) stands after G28, mm."""
        return dict(zip("XYZ", self.home, strict=True))

    @property
    def extruder(self) -> ExtruderDescription | None:
        """The extruder that is active at start."""
        return self.extruders[0] if self.extruders else None

    @property
    def steppers(self) -> tuple[StepperDescription, ...]:
        """All steppers: the head's, then those of the filament."""
        extruders = (extruder.stepper for extruder in self.extruders)
        return (*self.motors, *extruders, *(follower.stepper for follower in self.extruder_steppers))

    @property
    def extruder_motion(self) -> "ExtruderMotion":
        """Which filament steppers follow which extruder at start."""
        followed = {extruder.stepper.name: extruder.name for extruder in self.extruders}
        followed |= {follower.stepper.name: follower.extruder for follower in self.extruder_steppers}
        names = tuple(extruder.name for extruder in self.extruders)
        steppers = [extruder.stepper for extruder in self.extruders]
        steppers += [follower.stepper for follower in self.extruder_steppers]
        turns = {stepper.name: stepper.rotation_distance for stepper in steppers}
        return ExtruderMotion(names, names[0] if names else "", followed, turns)

"""The machine as the configuration describes it: frozen, checked, ready to be built."""

from enum import Enum

from coordinator.machine.pins import PinDescription
from coordinator.machine.problem import Place
from coordinator.motion.specs import MotionLimits
from nodes.records import record


@record
class CanConnection:
    """A node on a CAN bus."""

    uuid: str
    """12 lower-case hex digits."""
    interface: str
    """``can0`` (SocketCAN), ``virtual:PATH`` or ``INTERFACE:CHANNEL`` in python-can's words."""
    place: Place


@record
class UartConnection:
    """A node on a serial line."""

    path: str
    baud: int
    restart_method: str
    """arduino, cheetah, rpi_usb or command."""
    place: Place


class NodePolicy(Enum):
    """What becomes of the machine when a node is lost, shuts down or restarts; the value is its word."""

    FATAL = "fatal"
    """All nodes are stopped."""
    PAUSE = "pause"
    """The job waits at standstill until the node is back."""
    OPTIONAL = "optional"
    """The node's features are off until it is back; it may even be absent at start."""


@record
class NodeDescription:
    """One micro-controller; ``mcu`` is the primary whose clock is print time."""

    name: str
    connection: CanConnection | UartConnection
    place: Place
    policy: NodePolicy
    policy_place: Place
    """Where the policy is given; the section where it is not."""


@record
class StepperDescription:
    """One motor driver."""

    name: str
    """The section's name: stepper_x, stepper_z1, extruder."""
    step_pin: PinDescription
    dir_pin: PinDescription
    """Inverted: the pin is high for a step in negative direction."""
    enable_pin: PinDescription | None
    weights: tuple[float, float, float, float]
    """The stepper's position in mm is the sum of weights[i] * axis[i] over X Y Z E."""
    step_distance: float
    """mm per step."""
    rotation_distance: float
    """mm per turn of the output after the gears."""
    full_steps_per_rotation: int
    microsteps: int
    gear_ratio: float
    """Turns of the motor per turn of the output."""
    step_pulse_s: float
    """Shortest high time of the step pin; 0: the driver steps on both edges."""
    place: Place

    @property
    def node(self) -> str:
        """The node that drives it."""
        return self.step_pin.node


@record
class HomingDescription:
    """How a rail finds its origin; kept for the homing module: until then G28 takes the axis as home."""

    endstop_pin: PinDescription | None
    virtual_endstop: str
    """Such as ``probe:z_virtual_endstop``; empty when there is a pin or nothing."""
    position_endstop: float | None
    """mm; None with a virtual endstop that knows its own position, or without endstop."""
    speed: float
    """mm/s."""
    second_speed: float
    """mm/s of the second approach."""
    retract_distance: float
    """mm; 0: no second approach."""
    retract_speed: float
    positive_dir: bool
    """Whether the endstop stands at the upper end."""


@record
class RailDescription:
    """One axis with its steppers, which move together."""

    axis: str
    """x, y or z."""
    steppers: tuple[StepperDescription, ...]
    position_min: float
    """mm."""
    position_max: float
    homing: HomingDescription
    place: Place


@record
class ExtruderDescription:
    """The extruder's mechanics."""

    stepper: StepperDescription
    nozzle_diameter: float
    """mm."""
    filament_diameter: float
    """mm."""


@record
class NotYetActing:
    """What was recognised but belongs to a module that is not built yet."""

    section: str
    place: Place
    options: tuple[str, ...]
    """Their names; empty: the whole section."""

    def __str__(self) -> str:
        what = f"{', '.join(self.options)} of [{self.section}]" if self.options else f"[{self.section}]"
        return f"{self.place}: {what} recognised, not yet acting"


@record
class MachineDescription:
    """Everything the configuration says about the machine."""

    path: str
    nodes: tuple[NodeDescription, ...]
    """The primary first, then in the order of the file."""
    kinematics: str
    """cartesian or corexy."""
    limits: MotionLimits
    rails: tuple[RailDescription, RailDescription, RailDescription]
    """X Y Z; of a corexy the rail x has the motor that moves x + y, the rail y the one that moves x - y."""
    extruder: ExtruderDescription | None
    not_yet_acting: tuple[NotYetActing, ...]
    notes: tuple[str, ...]
    """Sentences about what has no effect."""

    @property
    def homed_position(self) -> dict[str, float]:
        """Where each axis (X, Y, Z) stands after G28, mm."""
        return {rail.axis.upper(): rail.homing.position_endstop or 0.0 for rail in self.rails}

    @property
    def steppers(self) -> tuple[StepperDescription, ...]:
        """All steppers: rails X Y Z, then the extruder."""
        extruder = (self.extruder.stepper,) if self.extruder else ()
        return (*(stepper for rail in self.rails for stepper in rail.steppers), *extruder)

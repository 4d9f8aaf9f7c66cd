"""The configured machine's devices: what each node is configured as, and what motion has to know of it."""

from collections.abc import Callable, Iterable, Mapping

from coordinator.config.model import (
    CanConnection,
    MachineDescription,
    NodePolicy,
    RailDescription,
    StepperDescription,
)
from coordinator.motion.specs import NodeStreamSpec, StepperSpec
from coordinator.tables.axle_map import StepperTables, stepper_tables
from nodes.devices.endstop import Endstop, SensorEndstop
from nodes.devices.stepper import Stepper
from nodes.devices.trsync import Trsync
from nodes.dictionary.dictionary import Dictionary
from nodes.dictionary.vocabulary import KNOWS_BUS_STOP
from nodes.node.config import NodeConfig


class MachineDevices:
    """The steppers and endstops of a machine and the devices of its modules; of the real and the offline one.

    CONFIGURE_MODULES adds to a node's configuration what modules have on that node.

    Call ``build_config`` for every node with its dictionary first; the specs are known afterwards.
    """

    def __init__(
        self, description: MachineDescription, configure_modules: Callable[[NodeConfig], None]
    ) -> None:
        self.description = description
        self._configure_modules = configure_modules
        self.steppers: dict[str, Stepper] = {s.name: _stepper(s) for s in description.steppers}
        self.endstops: dict[str, Endstop | SensorEndstop] = {
            rail.axis: _endstop(rail) for rail in description.stops
        }
        """By the name of the rail, or of the piece of one, that it stops."""
        self.trsyncs: dict[tuple[int, str], Trsync] = {
            (slot, node): Trsync(f"homing on node {node}") for slot, node in self._homing_nodes()
        }
        """By slot and node, of all that take part in homing: of rails homed together each has a slot."""
        self.tables = self._tables()
        """Compensation tables, of steppers whose axes may have such."""

    def _tables(self) -> "list[StepperTables]":
        if self.description.axis_tables is None:
            return []
        return stepper_tables(self.description, self.steppers)

    def build_config(self, node: str, dictionary: Dictionary) -> NodeConfig:
        """Return what NODE is to be configured as; raises CanductorError when it cannot be that."""
        config = NodeConfig(node, dictionary)
        pins = dictionary.enumerations.get("pin")
        numbers: Mapping[str, int] = pins.values if pins is not None else {}
        for stepper in self.description.steppers:
            if stepper.node == node:
                stepper.step_pin.number(numbers)  # raises with file and line when the node has no such pin
                stepper.dir_pin.number(numbers)
                self.steppers[stepper.name].configure(config)
        self._add_homing(config, numbers)
        for tables in self.tables:
            if tables.node == node:
                tables.configure(config)
        self._configure_modules(config)
        self._spread_shutdown(config)
        return config

    def _homing_nodes(self) -> dict[tuple[int, str], None]:
        """Return slots and nodes, each once, in order."""
        if not self.endstops:
            return {}
        pieces = {rail.axis: len(rail.pieces) for rail in self.description.rails}
        groups = self.description.kinematics.homing_order
        together = max((sum(pieces.get(name, 0) for name in group) for group in groups), default=1)
        nodes = [*self.moving_nodes, *(self.endstop_node(rail) for rail in self.description.stops)]
        return dict.fromkeys((slot, node) for node in nodes for slot in range(together))

    def _add_homing(self, config: NodeConfig, pins: Mapping[str, int]) -> None:
        for rail in self.description.stops:
            pin = rail.homing.endstop_pin
            if pin is not None and pin.node == config.name:
                if not pin.sensor:
                    pin.number(pins)
                self.endstops[rail.axis].configure(config)
        for (_, node), trsync in self.trsyncs.items():
            if node == config.name:
                trsync.configure(config)

    def endstop_node(self, rail: RailDescription) -> str:
        """Return the node of a rail's endstop, which is on a pin."""
        assert rail.homing.endstop_pin is not None
        return rail.homing.endstop_pin.node

    def _spread_shutdown(self, config: NodeConfig) -> None:
        """Make a node with policy fatal stop its whole bus when it shuts down, without the host."""
        described = next(n for n in self.description.nodes if n.name == config.name)
        knows = config.dictionary.int_constant(KNOWS_BUS_STOP, 0)
        on_can = isinstance(described.connection, CanConnection)
        if knows and on_can and described.policy is NodePolicy.FATAL:
            config.add_init("the bus-wide stop", "set_bus_stop enable=1")

    @property
    def moving_nodes(self) -> list[str]:
        """Names of the nodes that carry steppers, in the order of the description."""
        moving = {stepper.node for stepper in self.description.steppers}
        return [node.name for node in self.description.nodes if node.name in moving]

    def stepper_specs(self) -> list[StepperSpec]:
        """Return the steppers as step generation takes them; nodes count as in ``moving_nodes``."""
        order = {name: index for index, name in enumerate(self.moving_nodes)}
        return [self._spec(stepper, order[stepper.node]) for stepper in self.description.steppers]

    def _spec(self, described: StepperDescription, node: int) -> StepperSpec:
        stepper = self.steppers[described.name]
        assert stepper.oid is not None
        return StepperSpec(
            name=described.name,
            node=node,
            oid=stepper.oid,
            weights=described.weights,
            step_distance=described.step_distance,
            invert_dir=described.dir_pin.invert,
            step_pulse_s=described.step_pulse_s,
            formula=described.function.formula,
            params=described.function.params,
        )


def _endstop(rail: RailDescription) -> Endstop | SensorEndstop:
    pin = rail.homing.endstop_pin
    assert pin is not None
    if pin.sensor:
        return SensorEndstop(f"axis {rail.axis}")
    return Endstop(f"axis {rail.axis}", pin=pin.name, pull=pin.pull, invert=pin.invert)


def _stepper(described: StepperDescription) -> Stepper:
    return Stepper(
        described.name,
        step_pin=described.step_pin.name,
        dir_pin=described.dir_pin.name,
        invert_step=described.step_pin.invert,
        step_pulse_s=described.step_pulse_s,
    )


def stream_specs(nodes: Iterable[tuple[str, Dictionary, int]]) -> list[NodeStreamSpec]:
    """Return how each node (name, dictionary, queue slots for steps) takes step commands."""
    return [
        NodeStreamSpec(
            name=name,
            clock_freq=dictionary.clock_freq_hz,
            move_count=move_count,
            queue_step_id=dictionary.command("queue_step").message_id,
            set_next_step_dir_id=dictionary.command("set_next_step_dir").message_id,
            reset_step_clock_id=dictionary.command("reset_step_clock").message_id,
        )
        for name, dictionary, move_count in nodes
    ]

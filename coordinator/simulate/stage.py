"""The stage of a scenario: a simulated world with wires and boards, and the host a machine is run on."""

from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from coordinator.assembly.load import load_machine
from coordinator.config.model import CanConnection, MachineDescription, NodeDescription, UartConnection
from coordinator.runtime.host import Port as HostPort
from coordinator.simulate.actor import SimActor, bit_errors
from coordinator.simulate.boards import PS_PER_NS, Board
from coordinator.simulate.checker import QueueDepth
from coordinator.simulate.faults import NS, Faults
from coordinator.simulate.scenario import BusSetting, NodeSetting, Scenario
from coordinator.simulate.script import ScriptedWorld
from coordinator.simulate.truth import BoardTruth
from coordinator.support.toml_values import Dice, ScenarioError
from coordinator.verification.expected import Floats, Ints
from coordinator.virtual_machine.plant import PlantSettings, machine_plants
from nodes.clock.clock import HostTime
from nodes.link import LinkIO
from nodes.link.interfaces import LinkIoInterface, OnFrame, OnLost
from nodes.node.board_reset import SetLines, SetPower
from nodes.virtual._sim import lib
from nodes.virtual.plant import NodePlant
from nodes.virtual.sim_plant import SimPlant, connect_plants
from nodes.virtual.world import (
    CanController,
    CanPort,
    CanWire,
    ControllerSettings,
    Latency,
    PortSettings,
    Uart,
    UartPort,
    UartSettings,
    VirtualLoop,
    WorldNode,
)

GRID_S: Final = 0.005
"""Between two points of the primary clock's map; a ramp of 20 ppm/s bends by 0.1 ns over it."""
ADMIN_ID: Final = 0x3F0
SET_NODE_ID: Final = 1
LOAD_EVERY_NS: Final = 500_000
LOAD_OWED_BITS: Final = 4_000.0
"""What a sender may be behind with."""
LOAD_UUID: Final = "10ad00000000"
LIMIT_S: Final = 3600.0

_machine = lru_cache(load_machine)


class Stage:
    """What SCENARIO and SEED make. Everything about it is in true time."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self.scenario = scenario
        self.seed = seed
        self.dice = Dice(scenario.name, seed)
        self.description: MachineDescription = _machine(str(scenario.machine))
        self._world = ScriptedWorld(self.dice.stream("world").getrandbits(64))
        self._begin_ns = self._world.now_ns
        self._wires: dict[str, CanWire | Uart] = {}
        self._ports: dict[str, CanPort | UartPort] = {}
        self._boards: dict[str, Board] = {}
        for node in self.description.nodes:
            self._add_board(node.name, _wire_of(node), _uuid_of(node), scenario.nodes.get(node.name))
        for name, setting in scenario.nodes.items():
            if name not in self._boards:
                self._add_stranger(name, setting)
        self.host = SimHost(self._world, self._ports)
        for name, bus in scenario.buses.items():
            self._plug(name, bus)
        bus_of = {name: board.wire.name for name, board in self._boards.items()}
        self._plants: dict[str, SimPlant] = {}
        actor = SimActor(
            scenario.name, self._world, self._boards, self._wires, self._ports, plants=self._plants
        )
        self.faults = Faults(scenario, self.dice, actor, bus_of)
        for name, bus in scenario.buses.items():
            self._burden(name, bus)
        if scenario.plant:
            self.start_plants(machine_plants(self.description, PlantSettings(seed=seed)).values())

    # ------------------------------------------------------------------------------------------ assembly

    def _plug(self, name: str, setting: BusSetting) -> None:
        """Make a device one that disappears at resets of its node, or that resets its node."""
        port = self._ports.get(name)
        if setting.usb_of and port is not None:
            self._named(setting.usb_of, f"{self.scenario.name}: [buses.{name}]")
            gone_s = self._draw(setting, name, "usb_gone_s")
            self._boards[setting.usb_of].node.carries(port, gone_s)
        if setting.dtr:
            board = next(board for board in self._boards.values() if board.wire.name == name)
            self.host.reset_by_dtr[name] = board.node.reset

    def _draw(self, setting: BusSetting, wire: str, option: str) -> float:
        return self.dice.draw(getattr(setting, option), f"buses.{wire}.{option}")

    def _add_board(self, name: str, wire: str, uuid: str, setting: NodeSetting | None) -> None:
        self._boards[name] = Board(
            self._world, self._wire(wire), name, uuid=uuid, setting=setting or NodeSetting(), dice=self.dice
        )
        self._lose(self._boards[name], wire)

    def _add_stranger(self, name: str, setting: NodeSetting) -> None:
        where = f"{self.scenario.name}: [nodes.{name}]"
        if setting.same_uuid_as:
            of = self._named(setting.same_uuid_as, where)
            self._add_board(name, _wire_of(of), _uuid_of(of), setting)
        elif setting.uuid and setting.bus in self._wires:
            self._add_board(name, setting.bus, setting.uuid, setting)
        else:
            known = ", ".join(node.name for node in self.description.nodes)
            raise ScenarioError(
                f"{where}: the machine has {known}; a stranger needs uuid and bus, or same_uuid_as"
            )
        if setting.has_id:
            content = bytes([SET_NODE_ID]) + bytes.fromhex(setting.uuid) + bytes([setting.has_id])
            other = next(b for b in self._boards.values() if b.wire.name == setting.bus and b.name != name)
            assert other.node.controller is not None
            self._world.run_for(0.01)  # until it has booted
            other.node.controller.send(ADMIN_ID, content)

    def _named(self, name: str, where: str) -> NodeDescription:
        for node in self.description.nodes:
            if node.name == name:
                return node
        raise ScenarioError(f"{where}: the machine has no node '{name}'")

    def _wire(self, name: str) -> CanWire | Uart:
        if name not in self._wires:
            setting = self.scenario.buses.get(name, BusSetting())
            uart = any(
                isinstance(n.connection, UartConnection) and n.connection.path == name
                for n in self.description.nodes
            )
            delay_s = self._draw(setting, name, "delay_us") * 1e-6
            port = PortSettings(wake=Latency(8e-6, delay_s / 4, 8e-6 + delay_s))
            (self._add_uart if uart else self._add_can)(name, setting, port)
        return self._wires[name]

    def _add_can(self, name: str, setting: BusSetting, port: PortSettings) -> None:
        wire = self._world.add_can(
            name, bitrate=setting.bitrate, bit_errors=bit_errors(self._draw(setting, name, "errors"))
        )
        self._wires[name] = wire
        controller = ControllerSettings(
            queue=setting.queue_frames or ControllerSettings().queue,
            loss=self._draw(setting, name, "loss"),
            corruption=self._draw(setting, name, "corruption"),
        )
        self._ports[name] = self._world.add_can_port(wire, controller=controller, settings=port)

    def _add_uart(self, name: str, setting: BusSetting, port: PortSettings) -> None:
        baud = next(
            n.connection.baud
            for n in self.description.nodes
            if isinstance(n.connection, UartConnection) and n.connection.path == name
        )
        settings = UartSettings(
            baud=baud,
            loss=self._draw(setting, name, "loss"),
            corruption=self._draw(setting, name, "corruption"),
            noise_bytes=round(self._draw(setting, name, "noise_bytes")),
        )
        wire = self._wires[name] = self._world.add_uart(name, settings)
        self._ports[name] = self._world.add_uart_port(wire, settings=port)

    def _lose(self, board: Board, wire: str) -> None:
        """Let a board's own controller lose and damage what the wire's setting says."""
        setting = self.scenario.buses.get(wire)
        if setting is not None and board.node.controller is not None:
            board.node.controller.set_faults(
                loss=self._draw(setting, wire, "loss"), corruption=self._draw(setting, wire, "corruption")
            )

    def _burden(self, name: str, setting: BusSetting) -> None:
        """Put other traffic on a bus."""
        load, wire = self._draw(setting, name, "load"), self._wires.get(name)
        if wire is None:
            raise ScenarioError(f"{self.scenario.name}: [buses.{name}]: the machine has no such bus")
        if load <= 0 or not isinstance(wire, CanWire):
            return
        sender = self._world.add_node(wire, LOAD_UUID).controller
        assert sender is not None
        self._keep_sending(sender, setting.load_id, load * wire.bitrate)

    def _keep_sending(self, sender: CanController, first_id: int, bits_per_s: float) -> None:
        owed_bits, number = 0.0, 0

        def send() -> None:
            nonlocal owed_bits, number
            owed_bits = min(owed_bits + bits_per_s * LOAD_EVERY_NS / NS, LOAD_OWED_BITS)
            while owed_bits > 0:
                data = bytes((number + n) * 37 & 0xFF for n in range(8))
                if not sender.send(first_id + number % 4, data):
                    break  # the bus is full; what it cannot carry is lost, as a sensor's samples are
                owed_bits -= lib.can_frame_bits(first_id + number % 4, len(data), data)
                number += 1
            self._world.at(self._world.now_ns + LOAD_EVERY_NS, send)

        send()

    def start_plants(self, plants: Iterable[NodePlant]) -> dict[str, SimPlant]:
        """Connect the pins of boards with PLANTS from now on; return them by node. CanductorError."""
        started = {plant.node: self._boards[plant.node].node.start_plant(plant) for plant in plants}
        connect_plants(started)
        self._plants.update(started)
        return started

    # ------------------------------------------------------------------------------------------ performance

    def make_loop(self, *, executor_s: float = 0.0) -> VirtualLoop:
        """Return a loop in the world's time, whose threads take EXECUTOR_S for each thing they do."""
        return self.host.make_loop(executor_s=executor_s)

    def call_at(self, at_ns: int, what: Callable[[], object]) -> None:
        """Call WHAT at AT_NS of true time, between two events; the program goes on at once after it."""
        self._world.at(at_ns, what, wakes=True)

    def cut(self, node: str) -> None:
        """Cut the wires between NODE and its bus, for good."""
        controller = self._boards[node].node.controller
        if controller is None:
            raise ScenarioError(f"{self.scenario.name}: the node '{node}' is on no bus")
        controller.cut(1)

    def stall(self, seconds: float, *, io: bool = True) -> None:
        """Let the host's Python stand still from now on; IO: also the threads of its links."""
        self._world.stall(seconds, io=io)

    def now_ns(self) -> int:
        """Return true time, which is also the host's."""
        return self._world.now_ns

    # ------------------------------------------------------------------------------------------ truth

    def node(self, name: str) -> WorldNode:
        """Return the board NAME."""
        return self._boards[name].node

    def wires(self) -> list[CanWire | Uart]:
        """Return all buses and lines."""
        return list(self._wires.values())

    def port(self, wire: str) -> CanPort | UartPort:
        """Return the host's port on a bus or line, by the name that the configuration has for it."""
        return self._ports[wire]

    def board(self, node: str) -> BoardTruth:
        """Return what NODE's pins did."""
        return self._boards[node].truth()

    def clock_hz(self, node: str) -> int:
        """Return the nominal frequency of NODE's clock."""
        return self._boards[node].clock_hz

    def edges(self, node: str) -> npt.NDArray[Any]:
        """Return what NODE's pins did so far: ``pin``, ``level`` and ``true_ps`` of each change."""
        return self._boards[node].node.edges()

    def pins(self, node: str) -> dict[str, int]:
        """Return the numbers of NODE's pins."""
        return self._boards[node].pins

    def print_time(self, at_ns: Ints) -> Floats:
        """Return the print times of true times: the primary board's own clock at its nominal frequency."""
        ticks, true_ns = self._primary_grid(self._world.now_ns)
        clock = self._boards[self.description.nodes[0].name].clock_hz
        return np.asarray(np.interp(at_ns.astype(np.float64), true_ns, ticks / clock))

    def _primary_grid(self, until_ns: int) -> tuple[Floats, Floats]:
        if self._grid is None or self._grid[0] != until_ns:
            board = self._boards[self.description.nodes[0].name]
            step = round(board.clock_hz * GRID_S)
            now = board.node.clock
            elapsed = round((until_ns - self._begin_ns) / NS * board.clock_hz * 1.01)
            clocks = np.arange(max(0, now - elapsed), now + 2 * step, step, dtype=np.uint64)
            true_ns = board.node.true_ps(clocks).astype(np.float64) / PS_PER_NS
            self._grid = (until_ns, clocks.astype(np.float64), true_ns)
        return self._grid[1], self._grid[2]

    _grid: tuple[int, Floats, Floats] | None = None

    def elapsed_s(self) -> float:
        """Return how long it took, in simulated seconds."""
        return (self._world.now_ns - self._begin_ns) / NS

    def trace(self) -> int:
        """Return a hash of all events."""
        return self._world.trace

    def events(self) -> int:
        """Return how many events there were."""
        return self._world.events

    def fault_count(self) -> int:
        """Return how much went wrong: planned faults, and frames and bytes that were lost or damaged."""
        count = self.faults.happened()
        for wire, port in zip(self._wires.values(), self._ports.values(), strict=True):
            if isinstance(wire, Uart):
                found = wire.counters()
                count += found["lost"] + found["corrupted"] + found["noise"]
            else:
                assert isinstance(port, CanPort)
                count += wire.counters()["disturbed"]
                for controller in (port.controller, *self._controllers(wire)):
                    found = controller.counters()
                    count += found["lost"] + found["corrupted"]
        return count

    def _controllers(self, wire: CanWire) -> list[Any]:
        return [b.node.controller for b in self._boards.values() if b.wire is wire]

    def queues(self) -> list[QueueDepth]:
        """Return how deep the queues of the host's adapters were, and what found no room on a board."""
        depths = [
            QueueDepth(f"bytes beyond the receive buffer of {name}", board.overflow(), 0)
            for name, board in self._boards.items()
            if isinstance(board.wire, CanWire)
        ]
        for name, port in self._ports.items():
            if isinstance(port, CanPort):
                bound = self.scenario.buses.get(name, BusSetting()).queue_frames or ControllerSettings().queue
                deepest = port.controller.counters()["queue_max"]
                depths.append(QueueDepth(f"transmit queue of {name}", deepest, bound))
        return depths


class SimHost:
    """The computer, as the machine sees it: the world's time, and its ports by name."""

    def __init__(self, world: ScriptedWorld, ports: dict[str, CanPort | UartPort]) -> None:
        self._world = world
        self._ports = ports
        self.reset_by_dtr: dict[str, Callable[[], None]] = {}
        """By serial device that has DTR: what happens when it rises."""
        self.usb_switch: SetPower | None = None
        """What switches the power of the USB ports."""

    def make_loop(self, *, executor_s: float = 0.0) -> VirtualLoop:
        """Return a loop in the world's time; ``signal`` goes to the last one made."""
        self._loop = VirtualLoop(self._world, limit_s=LIMIT_S, executor_s=executor_s)
        return self._loop

    def signal(self, number: int, after_s: float = 0.0) -> None:
        """Send signal NUMBER, in AFTER_S of true time, to the program that runs then."""
        at_ns = self._world.now_ns + max(1, round(after_s * NS))
        self._world.at(at_ns, lambda: self._deliver(number), wakes=True)

    def _deliver(self, number: int) -> None:
        if self._loop is not None:
            self._loop.deliver(number)

    _loop: VirtualLoop | None = None

    def now(self) -> HostTime:
        """Return true time."""
        return HostTime(self._world.now_ns)

    def open_can(self, connection: CanConnection) -> HostPort:
        """Open the port of a simulated bus."""
        return self._open(self._ports[connection.interface])

    def open_uart(self, connection: UartConnection) -> HostPort:
        """Open the port of a simulated line."""
        port = self._ports[connection.path]
        reset = self.reset_by_dtr.get(connection.path)
        if reset is None:
            return self._open(port)
        level = False

        def set_lines(dtr: bool, rts: bool) -> None:  # noqa: ARG001
            nonlocal level
            if dtr and not level:
                reset()
            level = dtr

        if port.there:
            set_lines(True, True)
        return self._open(port, set_lines)

    def usb_power(self) -> SetPower | None:
        """Return what switches the power of the USB ports."""
        return self.usb_switch

    def _open(self, port: CanPort | UartPort, set_lines: SetLines | None = None) -> HostPort:
        def start(*, on_frame: OnFrame | None, on_closed: OnLost) -> LinkIoInterface:
            return LinkIO.driven_by(port.open(), on_frame=on_frame, on_closed=on_closed)

        return HostPort(port.name, start, lambda: None, set_lines)


def _wire_of(node: NodeDescription) -> str:
    connection = node.connection
    return connection.path if isinstance(connection, UartConnection) else connection.interface


def _uuid_of(node: NodeDescription) -> str:
    return node.connection.uuid if isinstance(node.connection, CanConnection) else "000000000001"

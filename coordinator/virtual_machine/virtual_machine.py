"""The stage of the demo: a machine's configuration played by virtual nodes on virtual or SocketCAN buses.

Their pins are connected with a plant of that machine: endstops switch where they are, heaters heat.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from coordinator.config.model import CanConnection, MachineDescription, NodeDescription, UartConnection
from coordinator.virtual_machine.plant import PlantSettings, machine_plants, start_point
from coordinator.virtual_machine.plant_heat import HeatSettings
from nodes.support.errors import CanductorError
from nodes.transport.socketcan import SocketCanTransport
from nodes.virtual.edge_log import EdgeLog
from nodes.virtual.hub import VirtualBus
from nodes.virtual.plant import Axis
from nodes.virtual.plant_log import PlantEvent, plant_log
from nodes.virtual.plant_page import Motor, PlantPage
from nodes.virtual.processes import Flavour, NodeProcess

BITRATE = 1_000_000
RATES_PPM = (-20.0, 60.0, -110.0, 35.0)
"""How wrong the oscillators are, node by node, unless set otherwise: as on boards without good crystals."""
ROLLOVER_AFTER_S = (1000.0, 20.0, 10.0, 35.0)
"""When the nodes' 32-bit clocks roll over: offsets that make some do it during the demo."""
JITTER_US = 40
WARM_C = {"heater_bed": 52.0, "extruder": 190.0}
"""How warm a machine is that has printed a few minutes ago."""
START_MM = 8.0
"""How far from where homing leaves it the head begins."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VirtualMachineOptions:
    """How the virtual hardware behaves."""

    loss: float = 0.0
    """Ratio of frames that virtual buses lose, 0 <= loss <= 0.5."""
    seed: int = 1
    """Decides which frames are lost."""
    rate_ppm: Mapping[str, float] = field(default_factory=dict)
    """By node: how much faster than nominal its clock runs."""
    start_clock: Mapping[str, int] = field(default_factory=dict)
    """By node: ticks its clock shows when the node starts."""
    cold: bool = False
    """The heaters start cold; else as warm as a few minutes after a print."""
    socketcan: Mapping[str, str] = field(default_factory=dict)
    """By CAN bus of the configuration: the SocketCAN interface that carries it, instead of a virtual bus.
    The empty name stands for all buses that are not named."""
    logs: bool = True
    """Nodes log their pins and plants, for a proof."""


def _plant_settings(description: MachineDescription, options: VirtualMachineOptions) -> PlantSettings:
    return PlantSettings(
        seed=options.seed + 1,
        start=start_point(description, START_MM),
        heat=HeatSettings(warm_c={} if options.cold else WARM_C),
    )


class VirtualMachine:
    """Virtual hardware for DESCRIPTION; a context manager that leaves no process behind.

    Every bus of the configuration becomes a virtual one in FOLDER, or the SocketCAN interface that the
    options name for it; every UART becomes a pseudo-terminal. The nodes' pins are connected with a plant.
    """

    def __init__(self, description: MachineDescription, options: VirtualMachineOptions, folder: Path) -> None:
        self._options = options
        self._folder = folder
        self._check_names(description)
        self._buses: dict[str, VirtualBus] = {}
        self._frames_before: dict[str, int] = {}
        self.processes: dict[str, NodeProcess] = {}
        self._stack = ExitStack()
        self._described = description
        self._plants = machine_plants(description, _plant_settings(description, options))
        self.description = self.of(description)
        """The machine with its connections replaced by virtual ones."""

    def _check_names(self, description: MachineDescription) -> None:
        names = [node.name for node in description.nodes]
        for name in [*self._options.rate_ppm, *self._options.start_clock]:
            if name not in names:
                raise CanductorError(f"the machine has no node '{name}'; it has {', '.join(names)}")
        buses = dict.fromkeys(
            node.connection.interface
            for node in description.nodes
            if isinstance(node.connection, CanConnection)
        )
        for name in self._options.socketcan:
            if not buses:
                raise CanductorError("the machine has no CAN bus; leave --socketcan out")
            if name and name not in buses:
                raise CanductorError(f"the machine has no CAN bus '{name}'; it has {', '.join(buses)}")

    def of(self, description: MachineDescription) -> MachineDescription:
        """Return DESCRIPTION, perhaps changed since the start, with its connections replaced by virtual ones.

        Raises CanductorError when its nodes are others than those that were started.
        """
        before, now = (
            {node.name: node.connection for node in nodes}
            for nodes in (self._described.nodes, description.nodes)
        )
        if changed := [name for name in before | now if before.get(name) != now.get(name)]:
            raise CanductorError(
                f"node '{changed[0]}' is not connected as when the virtual hardware was started; end the"
                " program and start it again"
            )
        return dataclasses.replace(description, nodes=tuple(map(self._virtual, description.nodes)))

    # ------------------------------------------------------------------------------------------ set up

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            for bus in {self._bus(node): None for node in self._described.nodes}:
                if isinstance(bus, Path):
                    self._buses[str(bus)] = stack.enter_context(
                        VirtualBus(bus, bitrate=BITRATE, loss=self._options.loss, seed=self._options.seed)
                    )
                elif bus is not None:
                    SocketCanTransport(bus).close()  # what is wrong with it is said before anything starts
                    self._frames_before[bus] = _frames_sent(bus)
            for index, node in enumerate(self._described.nodes):
                self.processes[node.name] = stack.enter_context(self._start(index, node))
            for process in self.processes.values():
                process.wait_ready()
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def _bus(self, node: NodeDescription) -> Path | str | None:
        """Return the virtual bus's socket, the SocketCAN interface's name, or None for a UART."""
        if isinstance(node.connection, UartConnection):
            return None
        name = node.connection.interface
        interfaces = self._options.socketcan
        if interface := interfaces.get(name, interfaces.get("")):
            return interface
        safe = "".join(c if c.isalnum() else "_" for c in name)
        return self._folder / f"{safe}.bus"

    def _uart_path(self, node: NodeDescription) -> Path:
        return self._folder / f"{node.name}.tty"

    def edge_log_path(self, node: str) -> Path:
        """Return where NODE logs its pins."""
        return self._folder / f"{node}.edges"

    def _virtual(self, node: NodeDescription) -> NodeDescription:
        connection: CanConnection | UartConnection
        bus = self._bus(node)
        if isinstance(node.connection, UartConnection):
            connection = dataclasses.replace(node.connection, path=str(self._uart_path(node)))
        else:
            interface = f"virtual:{bus}" if isinstance(bus, Path) else str(bus)
            connection = dataclasses.replace(node.connection, interface=interface)
        return dataclasses.replace(node, connection=connection)

    def _start(self, index: int, node: NodeDescription) -> NodeProcess:
        on_uart = isinstance(node.connection, UartConnection)
        flavour: Flavour = "mainboard" if index == 0 else "uart" if on_uart else "toolhead"
        rollover_s = ROLLOVER_AFTER_S[index % len(ROLLOVER_AFTER_S)]
        freq = CLOCK_FREQS[flavour]
        bus = self._bus(node)
        return NodeProcess(
            flavour,
            name=f"virtual node {node.name}",
            uuid=node.connection.uuid if isinstance(node.connection, CanConnection) else "000000000000",
            can=bus if isinstance(bus, Path) else None,
            socketcan=bus if isinstance(bus, str) else None,
            uart=self._uart_path(node) if on_uart else None,
            rate_ppm=self._options.rate_ppm.get(node.name, RATES_PPM[index % len(RATES_PPM)]),
            start_clock=self._options.start_clock.get(node.name, max(0, 2**32 - round(rollover_s * freq)))
            % 2**47,
            jitter_us=JITTER_US,
            seed=self._options.seed + index,
            edge_log=self.edge_log_path(node.name) if self._options.logs else None,
            plant=self._plants[node.name].write(self._folder),
            plant_log=self._options.logs,
        )

    @property
    def axes(self) -> dict[str, Axis]:
        """What moves, by the names of axes or of their first steppers."""
        return {axis.name: axis for plant in self._plants.values() for axis in plant.axes}

    def motors(self) -> dict[str, dict[str, Motor]]:
        """Return where every stepper truly is, by node and name; also after the nodes have ended."""
        return {node.name: self.plant_page(node.name).motors for node in self._described.nodes}

    def plant_page(self, node: str) -> PlantPage:
        """Return the truth about NODE's plant while it runs, in which faults can be switched."""
        return PlantPage.at(self._folder, node)

    def plant_log(self, node: str) -> Iterator[PlantEvent]:
        """Yield what NODE's heaters and fans did, and how warm its bodies were."""
        return plant_log(self._folder, node)

    # ------------------------------------------------------------------------------------------ afterwards

    def frames(self) -> tuple[int, int]:
        """Return how many frames were sent on all buses, and how many of them virtual ones lost."""
        stats = [bus.stats for bus in self._buses.values()]
        on_interfaces = sum(_frames_sent(name) - before for name, before in self._frames_before.items())
        return sum(s.frames for s in stats) + on_interfaces, sum(s.lost for s in stats)

    def stop_nodes(self) -> Mapping[str, Mapping[str, Any]]:
        """End the nodes that still run, so that their logs are complete; return their statistics."""
        return {name: process.stop() for name, process in self.processes.items() if process.running}

    def edge_log(self, node: str) -> EdgeLog:
        """Return NODE's log of pin levels."""
        return EdgeLog(self.edge_log_path(node))


def _frames_sent(interface: str) -> int:
    """Return how many frames this computer's programs have sent by INTERFACE, as its kernel counts."""
    return int(Path(f"/sys/class/net/{interface}/statistics/tx_packets").read_text())


CLOCK_FREQS: Mapping[Flavour, int] = {"mainboard": 168_000_000, "toolhead": 64_000_000, "uart": 16_000_000}

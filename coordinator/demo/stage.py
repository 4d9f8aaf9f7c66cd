"""The stage of the demo: a machine's configuration played by virtual nodes on a virtual bus."""

import dataclasses
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from coordinator.commands import DemoOptions
from coordinator.machine.description import (
    CanConnection,
    MachineDescription,
    NodeDescription,
    UartConnection,
)
from nodes.errors import CanductorError
from nodes.virtual.edge_log import EdgeLog
from nodes.virtual.hub import BusStats, VirtualBus
from nodes.virtual.processes import Flavour, NodeProcess

BITRATE = 1_000_000
RATES_PPM = (-20.0, 60.0, -110.0, 35.0)
"""How wrong the oscillators are, node by node, unless told otherwise: as on boards without good crystals."""
ROLLOVER_AFTER_S = (1000.0, 20.0, 10.0, 35.0)
"""When the nodes' 32-bit clocks roll over: offsets that make some do it during the demo."""
JITTER_US = 40


class Stage:
    """Virtual hardware for DESCRIPTION; a context manager that leaves no process behind.

    Every bus of the configuration becomes a virtual one in FOLDER, every UART a pseudo-terminal.
    """

    def __init__(self, description: MachineDescription, options: DemoOptions, folder: Path) -> None:
        self._options = options
        self._folder = folder
        self._check_names(description)
        self._buses: dict[str, VirtualBus] = {}
        self.processes: dict[str, NodeProcess] = {}
        self._stack = ExitStack()
        self._described = description
        self.description = dataclasses.replace(
            description, nodes=tuple(self._virtual(node) for node in description.nodes)
        )
        """The machine with its connections replaced by virtual ones."""

    def _check_names(self, description: MachineDescription) -> None:
        names = [node.name for node in description.nodes]
        for name in [*self._options.rate_ppm, *self._options.start_clock]:
            if name not in names:
                raise CanductorError(f"the machine has no node '{name}'; it has {', '.join(names)}")

    # ------------------------------------------------------------------------------------------ set up

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            for path in dict.fromkeys(self._bus_path(n) for n in self._described.nodes):
                if path is not None:
                    self._buses[path] = stack.enter_context(
                        VirtualBus(path, bitrate=BITRATE, loss=self._options.loss, seed=self._options.seed)
                    )
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

    def _bus_path(self, node: NodeDescription) -> str | None:
        if isinstance(node.connection, UartConnection):
            return None
        safe = "".join(c if c.isalnum() else "_" for c in node.connection.interface)
        return str(self._folder / f"{safe}.bus")

    def _uart_path(self, node: NodeDescription) -> Path:
        return self._folder / f"{node.name}.tty"

    def edge_log_path(self, node: str) -> Path:
        """Return where NODE logs its pins."""
        return self._folder / f"{node}.edges"

    def _virtual(self, node: NodeDescription) -> NodeDescription:
        connection: CanConnection | UartConnection
        path = self._bus_path(node)
        if isinstance(node.connection, UartConnection):
            connection = dataclasses.replace(node.connection, path=str(self._uart_path(node)))
        else:
            connection = dataclasses.replace(node.connection, interface=f"virtual:{path}")
        return dataclasses.replace(node, connection=connection)

    def _start(self, index: int, node: NodeDescription) -> NodeProcess:
        on_uart = isinstance(node.connection, UartConnection)
        flavour: Flavour = "mainboard" if index == 0 else "uart" if on_uart else "toolhead"
        rollover_s = ROLLOVER_AFTER_S[index % len(ROLLOVER_AFTER_S)]
        freq = CLOCK_FREQS[flavour]
        path = self._bus_path(node)
        return NodeProcess(
            flavour,
            name=f"virtual node {node.name}",
            uuid=node.connection.uuid if isinstance(node.connection, CanConnection) else "000000000000",
            can=None if path is None else Path(path),
            uart=self._uart_path(node) if on_uart else None,
            rate_ppm=self._options.rate_ppm.get(node.name, RATES_PPM[index % len(RATES_PPM)]),
            start_clock=self._options.start_clock.get(node.name, max(0, 2**32 - round(rollover_s * freq)))
            % 2**47,
            jitter_us=JITTER_US,
            seed=self._options.seed + index,
            edge_log=None if self._options.serve is not None else self.edge_log_path(node.name),
        )

    # ------------------------------------------------------------------------------------------ afterwards

    def bus_stats(self) -> Sequence[BusStats]:
        """Return the counters of the virtual buses."""
        return [bus.stats for bus in self._buses.values()]

    def stop_nodes(self) -> Mapping[str, Mapping[str, Any]]:
        """End the nodes that still run, so that their logs are complete; return their statistics."""
        return {name: process.stop() for name, process in self.processes.items() if process.running}

    def edge_log(self, node: str) -> EdgeLog:
        """Return NODE's log of pin levels."""
        return EdgeLog(self.edge_log_path(node))


CLOCK_FREQS: Mapping[Flavour, int] = {"mainboard": 168_000_000, "toolhead": 64_000_000, "uart": 16_000_000}

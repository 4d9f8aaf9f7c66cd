"""The demo's hardware in virtual time: simulated boards with a plant, and logs that its proof reads."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from coordinator.assembly.load import load_machine
from coordinator.demo.report import DemoReport
from coordinator.demo.run import print_and_prove
from coordinator.gcode.program import Program
from coordinator.simulate.scenario import BusSetting, NodeSetting
from coordinator.virtual_machine.plant import PlantSettings, start_point
from coordinator.virtual_machine.plant_heat import HeatSettings
from coordinator.virtual_machine.virtual_machine import START_MM, WARM_C
from nodes.virtual.edge_log import Clocks, Directions, steps_of
from nodes.virtual.plant_log import PlantEvent
from nodes.virtual.plant_page import Motor, PlantItemKind
from nodes.virtual.world import CanWire, WorldNode
from tests.stages.machine_stage import MachineStage

LOOK_S = 0.05
"""How often it is noted how warm everything is."""
Chunk = tuple[Clocks, npt.NDArray[np.uint16], npt.NDArray[np.uint8]]


class SimulatedLog:
    """What the pins of NODE did so far, with its true clock."""

    def __init__(self, node: WorldNode, clock_freq: float) -> None:
        self._node = node
        self._edges = node.edges()
        self.clock_freq = clock_freq
        self.start_clock = node.clock
        first, last = self._true_ns(
            np.array([self.start_clock - round(clock_freq), self.start_clock], np.uint64)
        )
        self.start_monotonic_ns = round(last)
        self.ticks_per_second = round(clock_freq) / ((last - first) * 1e-9)

    def _true_ns(self, clocks: Clocks) -> npt.NDArray[np.float64]:
        return self._node.true_ps(clocks).astype(np.float64) * 1e-3

    @property
    def record_count(self) -> int:
        return len(self._edges)

    def ticks_to_monotonic_ns(self, clock: Clocks, /) -> npt.NDArray[np.int64]:
        return np.rint(self._true_ns(np.asarray(clock, np.uint64))).astype(np.int64)

    def edges(self, *pins: int) -> Iterator[Chunk]:
        chosen = self._edges[np.isin(self._edges["pin"], pins)]
        yield chosen["clock"].copy(), chosen["pin"].copy(), chosen["level"].copy()

    def steps(
        self, step_pin: int, dir_pin: int, both_edges: bool, *, step_idle_level: int = 0
    ) -> Iterator[tuple[Clocks, Directions]]:
        chunks = self.edges(step_pin, dir_pin)
        yield from steps_of(chunks, step_pin, both_edges=both_edges, step_idle_level=step_idle_level)


class SimulatedDemo(MachineStage):
    """The hardware of ``canductor demo`` for the machine of CONFIG; its heaters begin warm, as there."""

    def __init__(
        self,
        config: Path,
        *,
        seed: int = 1,
        nodes: Mapping[str, NodeSetting] | None = None,
        buses: Mapping[str, BusSetting] | None = None,
    ) -> None:
        start = start_point(load_machine(str(config)), START_MM)
        plant = PlantSettings(seed=seed + 1, start=start, heat=HeatSettings(warm_c=WARM_C))
        super().__init__(config, seed=seed, nodes=nodes, buses=buses, plant=plant)
        self._warmth: list[tuple[str, PlantEvent]] = []

    def prove(self, gcode: str) -> DemoReport:
        """Print GCODE and prove every step; raises CanductorError."""
        self._look()
        return print_and_prove(self, Program.from_lines(gcode.splitlines(), "part.gcode"), self.host)

    def _look(self) -> None:
        now_ns = self.stage.now_ns()
        for node, plant in self.plants.items():
            page = plant.page
            for body in page.names(PlantItemKind.BODY):
                event = PlantEvent(now_ns, "body", body, page.temperature(body))
                self._warmth.append((node, event))
        self.stage.call_at(now_ns + round(LOOK_S * 1e9), self._look)

    # ------------------------------------------------- Hardware (coordinator/verification/hardware.py)

    def motors(self) -> Mapping[str, Mapping[str, Motor]]:
        return {name: plant.page.motors for name, plant in self.plants.items()}

    def edge_log(self, node: str) -> SimulatedLog:
        return SimulatedLog(self.node(node), self.stage.clock_hz(node))

    def plant_log(self, node: str) -> list[PlantEvent]:
        return [event for at, event in self._warmth if at == node]

    def frames(self) -> tuple[int, int]:
        wires = [wire for wire in self.stage.wires() if isinstance(wire, CanWire)]
        return sum(wire.counters()["frames"] for wire in wires), self.stage.fault_count()

    def stop_nodes(self) -> Mapping[str, Mapping[str, Any]]:
        return {node.name: {"late_us_max": 0.0} for node in self.description.nodes}

"""A machine on simulated boards in virtual time, with a plant around their pins: the base of other stages."""

import asyncio
from collections.abc import Callable, Coroutine, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from coordinator.gcode.program import Program
from coordinator.runtime.machine import Machine
from coordinator.service.core.job_runner import run_job
from coordinator.service.jobs.outcome import Outcome
from coordinator.simulate.scenario import BusSetting, NodeSetting, Scenario
from coordinator.simulate.stage import Stage
from coordinator.streaming.move_source import ProgramOutput
from coordinator.virtual_machine.plant import PlantSettings, machine_plants
from nodes.virtual.plant_page import PlantItemKind, PlantPage
from nodes.virtual.world import WorldNode

T = TypeVar("T")


class MachineStage:
    """The machine of the configuration file CONFIG; SEED decides clocks and delays.

    NODES and BUSES are as in a scenario file, by name. PLANT: what stands around the pins; None: nothing.
    ``host`` is the computer that commands and services run on.
    """

    def __init__(
        self,
        config: Path,
        *,
        seed: int = 1,
        nodes: Mapping[str, NodeSetting] | None = None,
        buses: Mapping[str, BusSetting] | None = None,
        plant: PlantSettings | None = None,
    ) -> None:
        self.config = config
        scenario = Scenario(
            name="test",
            given="test",
            about="A test.",
            machine=config,
            expect="completes",
            causes=(),
            weight=0.0,
            nodes=dict(nodes or {}),
            buses=dict(buses or {}),
        )
        self.stage = Stage(scenario, seed)
        self.host = self.stage.host
        self.description = self.stage.description
        described = {} if plant is None else machine_plants(self.description, plant)
        self.plants = self.stage.start_plants(described.values())
        self.axes = {axis.name: axis for each in described.values() for axis in each.axes}

    # ------------------------------------------------------------------------------------------------- time

    def run(self, main: Callable[[], Coroutine[Any, Any, T]]) -> T:
        """Run MAIN in virtual time."""
        with asyncio.Runner(loop_factory=self.stage.make_loop) as runner:
            return runner.run(main())

    def now_s(self) -> float:
        """Return true time in s."""
        return self.stage.now_ns() * 1e-9

    def at(self, after_s: float, what: Callable[[], object]) -> None:
        """Call WHAT in AFTER_S of true time, also while a command runs."""
        self.stage.call_at(self.stage.now_ns() + round(after_s * 1e9), what)

    def print_lines(
        self,
        lines: Iterable[str],
        *,
        on_output: Callable[[ProgramOutput], None] = lambda _: None,
        on_ready: Callable[[Machine], None] = lambda _: None,
    ) -> Outcome:
        """Run a program to its end, as a job; ON_OUTPUT gets what it says, ON_READY the connected machine."""
        return self.run(
            lambda: run_job(
                self.description,
                Program.from_lines(lines, "part.gcode"),
                on_output=on_output,
                on_ready=on_ready,
                host=self.host,
            )
        )

    # ------------------------------------------------------------------------------------------------ boards

    def node(self, name: str) -> WorldNode:
        """Return board NAME, to be reset or switched off."""
        return self.stage.node(name)

    def is_shut_down(self, name: str) -> bool:
        """Whether board NAME has shut itself down."""
        return bool(self.node(name).counters()["is_shutdown"])

    @property
    def shut_down(self) -> set[str]:
        """Names of the boards that have shut themselves down."""
        return {node.name for node in self.description.nodes if self.is_shut_down(node.name)}

    def edges(self, pin: str, node: str) -> list[tuple[float, int]]:
        """Return the changes of an output: true time (s) and level."""
        truth, number = self.stage.board(node), self.stage.pins(node)[pin]
        chosen = truth.pin == number
        times, levels = truth.at_ns[chosen], truth.level[chosen]
        return [(at * 1e-9, int(level)) for at, level in zip(times.tolist(), levels.tolist(), strict=True)]

    # ------------------------------------------------------------------------------------------------- plant

    def page(self, node: str) -> PlantPage:
        """Return the truth about NODE's plant, in which faults can be switched."""
        return self.plants[node].page

    def true_mm(self, axis: str) -> float:
        """Return where an axis truly is, or a rail by the name of its first motor (rad where it turns)."""
        motors = {term.node: self.page(term.node).motors for term in self.axes[axis].terms}
        return self.axes[axis].origin + sum(
            term.mm_per_step * motors[term.node][term.stepper].count for term in self.axes[axis].terms
        )

    def true_c(self, body: str) -> float:
        """Return how warm something truly is."""
        pages = (plant.page for plant in self.plants.values())
        return next(page.temperature(body) for page in pages if body in page.names(PlantItemKind.BODY))

"""A whole printer in a simulated world: a service, its boards, and the plant around their pins."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

from coordinator.demo.plant import PlantSettings, machine_plants
from coordinator.demo.plant_heat import HeatSettings
from coordinator.machine.description import MachineDescription, load_machine
from coordinator.modules.base import Value
from coordinator.simulate.scenario import Scenario
from coordinator.simulate.stage import Stage
from nodes.virtual.plant_page import Kind
from tests.stages.served import Served, running

CONFIG = Path("config/corexy_toolhead.cfg")
PRINTING = """
[pause_resume]
[virtual_sdcard]
path: jobs
[exclude_object]
[display_status]
[respond]
[gcode_arcs]
"""


class Printer:
    """The example machine with a toolhead board, with SECTIONS added; HURRY: how much faster all gets hot."""

    def __init__(self, folder: Path, sections: str = PRINTING, *, hurry: float = 30.0, seed: int = 1) -> None:
        self.folder = folder
        self.config = folder / "printer.cfg"
        # Heat that is hurried needs control that is.
        text = CONFIG.read_text(encoding="utf-8").replace("control: pid", "control: watermark")
        text = "\n".join(line for line in text.splitlines() if not line.lower().startswith("pid_"))
        self.config.write_text(text + "\n" + sections, encoding="utf-8")
        scenario = Scenario(
            name=folder.name,
            given="printer",
            about="Prints.",
            machine=self.config,
            expect="completes",
            causes=(),
            weight=0.0,
        )
        self.world = Stage(scenario, seed)
        settings = PlantSettings(seed=seed, heat=HeatSettings(hurry=hurry))
        self.plants = self.world.start_plants(machine_plants(self.world.description, settings).values())
        self.served: Served

    def load(self) -> MachineDescription:
        return load_machine(str(self.config))

    def run(self, *mains: Callable[[Served], Awaitable[None]]) -> None:
        """Run each of MAINS with a service of its own, one after the other."""

        async def whole() -> None:
            for main in mains:
                self.served = Served(self.folder, self.load, self.world.host)
                async with running(self.served):
                    await main(self.served)

        with asyncio.Runner(loop_factory=self.world.make_loop) as runner:
            runner.run(whole())

    def true_mm(self, axis: str) -> float:
        """Return where the head truly is along AXIS."""
        found = next(a for plant in self.plants.values() for a in plant.description.axes if a.name == axis)
        motors = {name: plant.page.motors for name, plant in self.plants.items()}
        return found.origin + sum(t.mm_per_step * motors[t.node][t.stepper].count for t in found.terms)

    def true_c(self, body: str) -> float:
        """Return how warm something truly is."""
        plants = self.plants.values()
        return next(p.page.temperature(body) for p in plants if body in p.page.names(Kind.BODY))

    def status(self, section: str) -> dict[str, Value]:
        assert self.served.service.machine is not None
        return dict(self.served.service.machine.modules.status()[section])


async def gcode(stage: Served, *lines: str) -> list[str]:
    """Have lines done; return what they answer."""
    told = await stage.call("gcode.run", script="\n".join(lines))
    replies = told["replies"]
    assert isinstance(replies, list)
    return [str(reply) for reply in replies]

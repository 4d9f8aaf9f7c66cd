"""A whole printer in a simulated world: a service, its boards, and the plant around their pins."""

from collections.abc import Awaitable, Callable
from pathlib import Path

from coordinator.assembly.load import load_machine
from coordinator.config.model import MachineDescription
from coordinator.support.values import Value
from coordinator.virtual_machine.plant import PlantSettings
from coordinator.virtual_machine.plant_heat import HeatSettings
from tests.stages.machine_stage import MachineStage
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


class Printer(MachineStage):
    """The example machine with a toolhead board, with SECTIONS added; HURRY: how much faster all gets hot."""

    def __init__(self, folder: Path, sections: str = PRINTING, *, hurry: float = 30.0, seed: int = 1) -> None:
        self.folder = folder
        config = folder / "printer.cfg"
        # Heat that is hurried needs control that is.
        text = CONFIG.read_text(encoding="utf-8").replace("control: pid", "control: watermark")
        text = "\n".join(line for line in text.splitlines() if not line.lower().startswith("pid_"))
        config.write_text(text + "\n" + sections, encoding="utf-8")
        plant = PlantSettings(seed=seed, heat=HeatSettings(hurry=hurry))
        super().__init__(config, seed=seed, plant=plant)
        self.served: Served

    def load(self) -> MachineDescription:
        return load_machine(str(self.config))

    def serve(self, *mains: Callable[[Served], Awaitable[None]]) -> None:
        """Run each of MAINS with a service of its own, one after the other."""

        async def whole() -> None:
            for main in mains:
                self.served = Served(self.folder, self.load, self.host)
                async with running(self.served):
                    await main(self.served)

        self.run(whole)

    def status(self, section: str) -> dict[str, Value]:
        assert self.served.service.machine is not None
        return dict(self.served.service.machine.modules.status()[section])


async def gcode(stage: Served, *lines: str) -> list[str]:
    """Have lines done; return what they answer."""
    told = await stage.call("gcode.run", script="\n".join(lines))
    replies = told["replies"]
    assert isinstance(replies, list)
    return [str(reply) for reply in replies]

"""A service in virtual time on a machine whose plant counts the motors' steps and knows where all is."""

from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path

import pytest

from coordinator.kinematics.base import Point
from coordinator.simulate.scenario import NodeSetting
from coordinator.virtual_machine.plant import PlantSettings
from coordinator.virtual_machine.plant_bed import BedSettings
from coordinator.virtual_machine.plant_heat import HeatSettings
from tests.stages.machine_stage import MachineStage
from tests.stages.safety_rig import MACHINE, START
from tests.stages.served import Served, running

STEP_MM = 40 / 200 / 16


class PlantStage(MachineStage):
    """A service on a machine whose plant knows where the head truly is."""

    def __init__(
        self,
        folder: Path,
        machine: Path = MACHINE,
        start: Point | None = START,
        *,
        nodes: Mapping[str, NodeSetting] | None = None,
        heat: HeatSettings | None = None,
        bed: BedSettings | None = None,
        **skew_mm: float,
    ) -> None:
        plant = PlantSettings(
            start=start, skew_mm=skew_mm, heat=heat or HeatSettings(), bed=bed or BedSettings()
        )
        super().__init__(machine, seed=3, nodes=nodes, plant=plant)
        self._highest_mm = 0.0
        self.served = Served(folder, lambda: self.description, self.host)

    def serve(self, main: Callable[[], Awaitable[None]]) -> None:
        """Run MAIN while the service runs."""

        async def whole() -> None:
            async with running(self.served):
                await main()

        self.run(whole)

    @property
    def second_approach(self) -> bool:
        """Whether Y is on its way back from its endstop."""
        self._highest_mm = max(self._highest_mm, self.true_mm("y"))
        return self.true_mm("y") < self._highest_mm - 1

    def check_place(self) -> None:
        """Compare where the service says that homed axes are with where they are."""
        x, y, z, _ = self.served.planned
        homed = str(self.served.tree.get("position.homed")).upper()
        for axis, at in (("x", x), ("y", y), ("z", z)):
            if axis.upper() in homed and axis in self.axes:
                assert at == pytest.approx(self.true_mm(axis), abs=1.6 * STEP_MM), axis

    async def check_all(self) -> None:
        """Compare all that has an endstop with what the service says of it, in steps."""
        lost = {n: m.lost for plant in self.plants.values() for n, m in plant.page.motors.items() if m.lost}
        assert not lost, "drivers are on and axes within their stops whenever a step comes"
        told = await self.served.call("position.get", ask_nodes=True)
        dual = self.description.dual_carriage
        shared = "" if dual is None else "xyz"[dual.carriages.axis]
        planned = {a: at for a, at in zip("xyz", self.served.planned, strict=False) if a != shared}
        steps = {s.name: s.step_distance for s in self.description.steppers}
        off = {}
        for name, axis in self.axes.items():
            at = planned[name] if name in planned else told["rails"][_motor(name)]
            off[name] = (at - self.true_mm(name)) / steps[axis.terms[0].stepper]
        assert all(abs(steps) < 1.7 for steps in off.values()), off
        head = [told["kinematic"][axis] for axis in "xyz"]
        assert head == pytest.approx(self.served.planned[:3], abs=0.03)


def _motor(name: str) -> str:
    return f"stepper_{name}" if name in "xyz" else name

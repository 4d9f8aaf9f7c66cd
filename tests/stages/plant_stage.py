"""A service in virtual time on a machine whose plant counts the motors' steps and knows where all is."""

from collections.abc import Mapping
from pathlib import Path

import pytest

from coordinator.demo.plant import PlantSettings, machine_plants
from coordinator.demo.plant_heat import HeatSettings
from coordinator.kinematics.base import Point
from coordinator.simulate.safety_rig import MACHINE, START
from coordinator.simulate.scenario import NodeSetting, Scenario
from coordinator.simulate.stage import Stage
from tests.stages.served import Served

STEP_MM = 40 / 200 / 16


class PlantStage:
    """A service on a machine whose plant tells where the head truly is."""

    def __init__(
        self,
        folder: Path,
        machine: Path = MACHINE,
        start: Point | None = START,
        *,
        nodes: Mapping[str, NodeSetting] | None = None,
        heat: HeatSettings | None = None,
        **skew_mm: float,
    ) -> None:
        scenario = Scenario(
            name="plant",
            given="plant",
            about="A plant tells.",
            machine=machine,
            expect="completes",
            causes=(),
            weight=0.0,
            nodes=dict(nodes or {}),
        )
        self.stage = Stage(scenario, 3)
        described = machine_plants(
            self.stage.description,
            PlantSettings(start=start, skew_mm=skew_mm, heat=heat or HeatSettings()),
        )
        self.plants = self.stage.start_plants(described.values())
        self.axes = {axis.name: axis for plant in described.values() for axis in plant.axes}
        self._highest_mm = 0.0
        self.served = Served(folder, lambda: self.stage.description, self.stage.host)

    def true_mm(self, axis: str) -> float:
        """Return where an axis is, or a rail by the name of its first motor (rad where it turns)."""
        return self.axes[axis].origin + sum(
            term.mm_per_step * self.plants[term.node].page.motors[term.stepper].count
            for term in self.axes[axis].terms
        )

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
        dual = self.stage.description.dual_carriage
        shared = "" if dual is None else "xyz"[dual.carriages.axis]
        planned = {a: at for a, at in zip("xyz", self.served.planned, strict=False) if a != shared}
        steps = {s.name: s.step_distance for s in self.stage.description.steppers}
        off = {}
        for name, axis in self.axes.items():
            at = planned[name] if name in planned else told["rails"][_motor(name)]
            off[name] = (at - self.true_mm(name)) / steps[axis.terms[0].stepper]
        assert all(abs(steps) < 1.7 for steps in off.values()), off
        head = [told["kinematic"][axis] for axis in "xyz"]
        assert head == pytest.approx(self.served.planned[:3], abs=0.03)


def _motor(name: str) -> str:
    return f"stepper_{name}" if name in "xyz" else name

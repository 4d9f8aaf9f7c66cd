"""DELTA_CALIBRATE and DELTA_ANALYZE on a simulated delta that differs from its configuration by known errors.

Switches and motors are simulated; where the nozzle is follows from the carriages by the true figures, also
for the plant's probe.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.ipc.protocol.methods import ApiError
from coordinator.kinematics.delta import Delta
from coordinator.modules.levelling.delta_fit import Ways, nozzle_at, ways_at
from coordinator.support.examples import EXAMPLES
from coordinator.virtual_machine.plant_bed import BedSettings
from tests.stages.plant_stage import PlantStage

WIDTH_MM = 9.05
PILLARS = [(0.0, 0.0)] + [
    (65 * math.cos(math.radians(210 + 60 * i)), 65 * math.sin(math.radians(210 + 60 * i))) for i in range(6)
]
WITHIN_MM = 0.010
PROBE = """
[probe]
pin: ^PG3
z_offset: 1.5
x_offset: 12
y_offset: -7
speed: 5
"""


def truth(configured: Delta, rods: float = 1.0) -> Delta:
    """Return what the machine really is; RODS: share of the errors of its rods."""
    errors = ((0.4, 0.7, 0.5 * rods), (-0.5, -0.9, -0.6 * rods), (0.0, 0.2, 0.3 * rods))
    a, b, c = (
        replace(
            tower,
            angle=tower.angle + math.radians(degrees),
            endstop_height=tower.endstop_height + end,
            rod_length=tower.rod_length + rod,
        )
        for tower, (degrees, end, rod) in zip(configured.towers, errors, strict=True)
    )
    return replace(configured, radius=configured.radius + 1.2, towers=(a, b, c))


def machine(folder: Path, probe: str = "") -> Path:
    """Return the example with fine steps, so that they matter less than what is to be found, and PROBE."""
    text = (EXAMPLES / "delta.cfg").read_text(encoding="utf-8")
    text = text.replace("microsteps: 16\nrotation_distance: 40", "microsteps: 128\nrotation_distance: 40")
    path = folder / "delta.cfg"
    height = 8 if probe else 1.5
    section = f"[delta_calibrate]\nradius: 110\nspeed: 100\nhorizontal_move_z: {height}\n"
    path.write_text(text + section + probe)
    return path


class Bench:
    """The machine, and someone who sees where its nozzle really is."""

    def __init__(self, folder: Path, probe: str = "") -> None:
        path = machine(folder, probe)
        configured = load_machine(str(path)).kinematics
        assert isinstance(configured, Delta)
        self.configured, self.true = configured, truth(configured, rods=0.0 if probe else 1.0)
        self.stage = PlantStage(folder, path, (0.0, 0.0, 399.0), bed=BedSettings(delta=self.true))

    async def run(self, script: str) -> list[str]:
        return list((await self.stage.served.call("gcode.run", script=script))["replies"])

    def true_z(self) -> float:
        a, b, c = (
            end - self.stage.true_mm(f"stepper_{name}")
            for end, name in zip(self.configured.endstop_positions, "abc", strict=True)
        )
        return nozzle_at(self.true, (a, b, c))[2]

    async def calibrate(self) -> list[str]:
        """Measure seven places by hand."""
        told = await self.run("DELTA_CALIBRATE METHOD=manual")
        for _ in range(7):
            for _ in range(2):
                await self.run(f"TESTZ Z={-self.true_z():.5f}\nM400")
            assert self.true_z() == pytest.approx(0, abs=0.002)
            told = await self.run("ACCEPT")
        return told

    def measured(self, first: int, second: int) -> float:
        """Return a length of the object that was printed by the configured figures, edge to edge."""
        places = [nozzle_at(self.true, self.printed(number)) for number in (first, second)]
        return math.dist(*places) + WIDTH_MM

    def printed(self, number: int) -> Ways:
        return ways_at(self.configured, (*PILLARS[number], 0.0))

    @property
    def unsaved(self) -> Mapping[str, Mapping[str, str]]:
        assert self.stage.served.service.machine is not None
        return self.stage.served.service.machine.unsaved.pending


def test_planted_errors_are_found(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.stage.serve(lambda: check(bench))


def test_a_probe_finds_planted_errors(tmp_path: Path) -> None:
    bench = Bench(tmp_path, PROBE)

    async def main() -> None:
        await bench.run("G28\nG1 X0 Y0 Z10 F9000")
        told = await bench.run("DELTA_CALIBRATE")
        assert told[-1] == "SAVE_CONFIG writes them and restarts"
        check_figures(bench)

    bench.stage.serve(main)


async def check(bench: Bench) -> None:
    with pytest.raises(ApiError, match="before Z is homed"):
        await bench.run("DELTA_CALIBRATE")
    with pytest.raises(ApiError, match="needs CENTER_DISTS, CENTER_PILLAR_WIDTHS"):
        await bench.run("DELTA_ANALYZE CALIBRATE=extended")
    await bench.run("G28\nG1 X0 Y0 Z3 F9000")
    told = await bench.calibrate()
    assert told[-1] == "SAVE_CONFIG writes them and restarts"
    assert len(bench.unsaved["delta_calibrate"]) == 14
    lists = {
        "CENTER_DISTS": [bench.measured(0, i) for i in range(1, 7)],
        "OUTER_DISTS": [bench.measured(i, i % 6 + 1) for i in range(1, 7)],
        "CENTER_PILLAR_WIDTHS": [WIDTH_MM] * 3,
        "OUTER_PILLAR_WIDTHS": [WIDTH_MM] * 6,
    }
    with pytest.raises(ApiError, match="give 6 lengths in mm"):
        await bench.run("DELTA_ANALYZE CENTER_DISTS=74,74,74")
    for name, values in lists.items():
        await bench.run(f"DELTA_ANALYZE {name}={','.join(f'{value:.4f}' for value in values)}")
    await bench.run("DELTA_ANALYZE SCALE=1.0")
    told = await bench.run("DELTA_ANALYZE CALIBRATE=extended")
    assert told[-2].startswith("the worst of 12 lengths is 0.00")
    check_figures(bench)


def check_figures(bench: Bench) -> None:
    """Compare what SAVE_CONFIG would write with the truth."""
    true, found = bench.true, bench.unsaved
    assert float(found["printer"]["delta_radius"]) == pytest.approx(true.radius, abs=WITHIN_MM)
    for name, tower in zip("abc", true.towers, strict=True):
        values = {option: float(text) for option, text in found[f"stepper_{name}"].items()}
        assert values["position_endstop"] == pytest.approx(tower.endstop_height, abs=WITHIN_MM)
        assert values["arm_length"] == pytest.approx(tower.rod_length, abs=WITHIN_MM)
        angle = math.degrees(WITHIN_MM / true.radius)
        assert values["angle"] == pytest.approx(math.degrees(tower.angle), abs=angle)

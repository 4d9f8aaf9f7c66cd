"""Probing while something fails: the nozzle goes no deeper than stated, and every stop is explained.

Each seed decides the bed, the clocks, the lost frames, what fails and when.
"""

import random
import re
from pathlib import Path

import pytest

from coordinator.virtual_machine.plant_bed import BedSettings
from nodes.support.errors import CanductorError
from nodes.virtual.plant import Bed
from nodes.virtual.plant_page import PlantFault, PlantItemKind
from tests.profiles import is_full
from tests.stages.probe_stage import OFFSET, ProbeStage, bed_height, machine_text

SEEDS = 200 if is_full() else 9
LOWEST_MM = -0.5
"""position_min of Z."""
SPEED = 8.0
"""mm/s of the first approach, the fastest way down."""
TIMEOUT_S = 0.25
"""A node that hears nothing of the host for so long stops by itself."""
BEYOND_MM = 0.15
"""What the bed is higher elsewhere, and what the head goes on while it brakes."""
FAULTS = ("none", "never", "always", "cut toolhead", "cut mcu", "stall", "stuck", "late")
KINDS = ("probe", "bltouch", "load_cell_probe")
CELL_SPEED = 4.0
"""The same for a load cell, whose probe is the nozzle itself."""
CELL_FAULTS = {
    "never": PlantFault.NEVER,
    "always": PlantFault.SHORTED,
    "stuck": PlantFault.DEAD,
    "late": PlantFault.OPEN,
}
SWITCH_FAULTS = {
    "never": PlantFault.NEVER,
    "always": PlantFault.ALWAYS,
    "stuck": PlantFault.STUCK,
    "late": PlantFault.LATE,
}
EXPLAINED = (
    r"the probe did not trigger within \d+\.\d+ mm: .*; (Z is -?\d|the head was lowered)",
    r"the probe was triggered before the move: lift the head.*; (Z is -?\d|the head was lowered)",
    r"lost node (toolhead|mcu)|node (toolhead|mcu) (did not|does not|was lost)",
    r"did not hear from the host for 0\.25 s and stopped by itself",
    # A probe that closes by itself on the way down, and a host that stood still while the head travelled.
    r"the samples are \d+\.\d+ mm apart, more than samples_tolerance",
    r"node mcu shut down: Stepper too far in past",
    r"node toolhead shut down: Timer too close",
    r"the BLTouch did not (lower|raise) its pin: 3 times .*; (Z is -?\d|the head was lowered)",
    r"arming its nodes took too long",
    r"the sensor (makes no readings|is at its limit): check",
    r"the force (left its safe range|at rest is -?\d+ g)",
    r"the force (did not fall|changed by \d+\.\d g all the way)",
    r"the nozzle left the bed (at once|only at its end)",
)


class Case:
    """One seed."""

    def __init__(self, folder: Path, seed: int) -> None:
        chance = random.Random(seed)
        shape = Bed(
            x0=100, y0=100, tilt_x=chance.uniform(-5e-4, 5e-4), tilt_y=chance.uniform(-5e-4, 5e-4), radius=150
        )
        self.fault = FAULTS[seed % len(FAULTS)]
        kind = KINDS[seed // len(FAULTS) % len(KINDS)] if is_full() else KINDS[seed % len(KINDS)]
        self.is_cell = kind == "load_cell_probe"
        fast, above = (CELL_SPEED, 0.0) if self.is_cell else (SPEED, OFFSET[2])
        self.bound_mm = max(TIMEOUT_S * fast - above, -LOWEST_MM + 0.5) + BEYOND_MM
        """How far below the bed the nozzle may get: what a node goes on without the others, or 0.5 mm below
        position_min."""
        z = {"position_min": LOWEST_MM, "homing_speed": fast}
        text = machine_text(z=z, kind=kind, speed=chance.uniform(1, 6 if above else CELL_SPEED))
        bed = BedSettings(shape=shape, noise_mm=chance.uniform(0, 0.02), hysteresis_mm=chance.uniform(0, 0.2))
        start = (0.0, 0.0, chance.uniform(4, 14))
        self.stage = ProbeStage(
            folder, text, seed=seed, loss=chance.choice((0.0, 0.01)), bed=bed, start=start
        )
        self.deepest_mm = 0.0
        if self.fault.startswith("cut"):
            self.stage.at(chance.uniform(3, 16), self.fail)
        else:  # behind the first approach, before which the place of Z is not known
            after_s = chance.uniform(0, 8)
            self.stage.when(self._found, lambda: self.stage.at(after_s, self.fail))
        self.stage.at(0.0, self._watch)

    def _found(self) -> bool:
        x, y, z = self._nozzle
        if self.is_cell:
            return z <= bed_height(self.stage.bed.shape, x, y) + 0.05
        return z <= self.stage.trigger_z(x, y) + 0.05

    @property
    def _nozzle(self) -> tuple[float, float, float]:
        steps = {name: motor.count for name, motor in self.stage.page("mcu").motors.items()}
        return (steps["stepper_x"] / 80, steps["stepper_y"] / 80, self.stage.true_mm("z"))

    def _watch(self) -> None:
        """Look how deep the nozzle is, 200 times a second."""
        x, y, z = self._nozzle
        self.deepest_mm = max(self.deepest_mm, bed_height(self.stage.bed.shape, x, y) - z)
        self.stage.at(0.005, self._watch)

    def fail(self) -> None:
        """Let it fail."""
        if self.fault.startswith("cut"):
            self.stage.stage.cut(self.fault.split()[1])
        elif self.fault == "stall":
            self.stage.stage.stall(0.6)
        elif self.fault != "none" and self.is_cell:
            page = self.stage.page("toolhead")
            page.set_fault(PlantItemKind.LOAD_CELL, "probe", CELL_FAULTS[self.fault])
        elif self.fault != "none":
            self.stage.fault(SWITCH_FAULTS[self.fault])

    def run(self) -> str:
        """Home, and probe some places; return how it ended."""
        lines = ["G28"]
        for x in (30, 90, 150):
            lines += ["G1 Z4 F1200", f"G1 X{x} Y{x} F9000", "PROBE SAMPLES=2"]
        try:
            self.stage.do(*lines)
        except CanductorError as error:
            return str(error)
        return ""


@pytest.mark.parametrize("seed", range(SEEDS))
def test_no_crash_is_deeper_than_stated_and_every_stop_is_explained(tmp_path: Path, seed: int) -> None:
    case = Case(tmp_path, seed)
    said = case.run()
    assert case.deepest_mm < case.bound_mm, (case.fault, said)
    if case.fault == "none":
        assert not said
    else:
        assert not said or any(re.search(pattern, said) for pattern in EXPLAINED), said

"""A machine with a probe above a virtual bed, in virtual time; the truth about it by formulas of its own.

X and Y have no endstops: G28 takes them as home at 0, where the head begins. The probe is on another node
than the motors.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from coordinator.runtime.machine import Machine
from coordinator.simulate.scenario import BusSetting
from coordinator.support.toml_values import Range
from coordinator.virtual_machine.plant import PlantSettings
from coordinator.virtual_machine.plant_bed import BedSettings
from coordinator.virtual_machine.plant_heat import HeatSettings
from nodes.virtual.plant import Bed
from nodes.virtual.plant_page import PlantFault, PlantItemKind
from tests.stages.machine_stage import MachineStage
from tests.stages.printer_text import MCU, TOOLHEAD, printer_section, section, stepper_section

MICROSTEP_MM = 8 / 200 / 16
OFFSET = (20.0, 10.0, 1.5)
"""Of the probe from the nozzle."""
START = (0.0, 0.0, 8.0)
PROBE: Mapping[str, object] = {
    "pin": "^toolhead:PC5",
    "x_offset": OFFSET[0],
    "y_offset": OFFSET[1],
    "z_offset": OFFSET[2],
    "speed": 5,
}
KINDS: Mapping[str, Mapping[str, object]] = {
    "probe_eddy_current coil": {
        **dict.fromkeys(("pin", "z_offset")),
        "sensor_type": "ldc1612",
        "i2c_mcu": "toolhead",
        "reg_drive_current": 15,
    },
    "load_cell_probe": {
        **dict.fromkeys(("pin", "x_offset", "y_offset", "z_offset")),
        "sensor_type": "hx711",
        "dout_pin": "toolhead:PC5",
        "sclk_pin": "toolhead:PC6",
        "counts_per_gram": 100,
        "reference_tare_counts": 20000,
    },
    "bltouch": {"pin": None, "sensor_pin": "^toolhead:PC5", "control_pin": "toolhead:PB0"},
}
"""What other kinds of probes have in their sections."""


def machine_text(
    *,
    z: Mapping[str, object] | None = None,
    further_z: int = 0,
    sections: str = "",
    kind: str = "probe",
    **probe: object,
) -> str:
    """Return the configuration: with options of [stepper_z] and of the probe, whose section is KIND.

    Z has so many further motors.
    """
    options = {**PROBE, **KINDS.get(kind, {}), **probe}
    axis: dict[str, object] = {"rotation_distance": 8, "position_min": -3, "position_max": 200}
    axis |= {"endstop_pin": "probe:z_virtual_endstop", "homing_speed": 8, "second_homing_speed": 3}
    axis |= {"homing_retract_dist": 3} | dict(z or {})
    return (
        MCU
        + TOOLHEAD
        + printer_section(max_z_velocity=20, max_z_accel=500)
        + stepper_section("stepper_x", "PB0", "PB1", position_max=200)
        + stepper_section("stepper_y", "PB3", "!PB4", position_max=200)
        + stepper_section("stepper_z", "PB6", "PB7", **axis)
        + "".join(
            stepper_section(f"stepper_z{number}", f"PD{number}", f"PE{number}", rotation_distance=8)
            for number in range(1, further_z + 1)
        )
        + section(kind, **{name: value for name, value in options.items() if value is not None})
        + sections
    )


class ProbeStage(MachineStage):
    """The machine of TEXT whose bed has a SHAPE; LOSS: share of frames that vanish."""

    def __init__(
        self,
        folder: Path,
        text: str = "",
        *,
        seed: int = 1,
        loss: float = 0.0,
        bed: BedSettings | None = None,
        heat: HeatSettings | None = None,
        start: tuple[float, float, float] = START,
        switch_noise_mm: float = 0.0,
    ) -> None:
        path = folder / "probe.cfg"
        path.write_text(text or machine_text(), encoding="utf-8")
        buses = {"can0": BusSetting(loss=Range(loss, loss))} if loss else None
        self.bed = bed or BedSettings()
        self.output: list[str] = []
        self.on_echo: dict[str, Callable[[], None]] = {}
        """What is called when a line M118 says that."""
        self.machine: Machine | None = None
        plant = PlantSettings(seed=seed, start=start, bed=self.bed, heat=heat or HeatSettings())
        plant = replace(plant, switch_noise_mm=switch_noise_mm)
        super().__init__(path, seed=seed, buses=buses, plant=plant)

    def do(self, *lines: str, on_ready: Callable[[Machine], None] = lambda _: None) -> list[str]:
        """Run LINES as a program; return what it said."""

        def ready(machine: Machine) -> None:
            self.machine = machine
            on_ready(machine)

        def hear(told: Any) -> None:
            self.output.append(told.text)
            self.on_echo.get(told.text.removeprefix("echo: "), lambda: None)()

        self.print_lines(lines, on_output=hear, on_ready=ready)
        return self.output

    def steps(self, step_pin: str, dir_pin: str, node: str) -> tuple[np.ndarray, np.ndarray]:
        """Return when a motor made its steps, s, and whether upwards."""
        at = np.array([at for at, level in self.edges(step_pin, node) if level])
        turns = [(-np.inf, 0), *self.edges(dir_pin, node)]
        last = np.searchsorted([turn for turn, _ in turns], at, side="right") - 1
        return at, np.array([level for _, level in turns], bool)[last]

    def fault(self, fault: PlantFault) -> None:
        """Let the probe fail."""
        self.page(self.probe_node).set_fault(PlantItemKind.SWITCH, "probe", fault)

    def when(self, true: Callable[[], bool], what: Callable[[], object], look_s: float = 0.005) -> None:
        """Call WHAT as soon as it is seen to be TRUE."""

        def look() -> None:
            if true():
                what()
            else:
                self.at(look_s, look)

        self.at(look_s, look)

    def fault_above(self, z: float, fault: PlantFault) -> None:
        """Let the probe fail when the head has been low and is truly at Z or higher."""
        self.when(
            lambda: self.true_mm("z") < z,
            lambda: self.when(lambda: self.true_mm("z") >= z, lambda: self.fault(fault)),
        )

    @property
    def probe_node(self) -> str:
        """The node of the probe."""
        probe = self.description.probe
        assert probe is not None
        assert probe.rail.homing.endstop_pin is not None
        return probe.rail.homing.endstop_pin.node

    def trigger_z(self, x: float, y: float) -> float:
        """Return the height at which the nozzle at X, Y triggers the probe, exactly."""
        return bed_height(self.bed.shape, x + OFFSET[0], y + OFFSET[1]) + OFFSET[2]


def bed_height(bed: Bed, x: float, y: float) -> float:
    """Return the height of BED at X, Y by the formula of docs/plant.md."""
    dx, dy = x - bed.x0, y - bed.y0
    return bed.z + bed.tilt_x * dx + bed.tilt_y * dy + bed.bow * (1 - (dx**2 + dy**2) / bed.radius**2)


def heights(output: Iterable[str]) -> list[float]:
    """Return what every measurement among OUTPUT found, mm."""
    return [float(text.rpartition("z=")[2]) for text in output if text.startswith("probe at ")]

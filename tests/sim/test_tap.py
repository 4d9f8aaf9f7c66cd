"""The nozzle as probe: [probe] as in a Voron Tap's published configuration, lines and all."""

import re
from pathlib import Path
from typing import Any

import pytest

from coordinator.virtual_machine.plant_bed import BedSettings
from coordinator.virtual_machine.plant_heat import HeatSettings
from nodes.virtual.plant import Bed
from tests.profiles import is_full
from tests.stages.printer_text import section
from tests.stages.probe_stage import MICROSTEP_MM, ProbeStage, bed_height, heights, machine_text

REAL = Path(__file__).parents[3] / "shared/data/config/real/users"
TAP = "Alex3DLabs_Klipper_Configs_Voron_2_4_R2_TAPConfig_printer_cfg.cfg"
TILTED = BedSettings(shape=Bed(z=0.2, x0=100, y0=100, tilt_x=0.002, tilt_y=-0.001))
TRIGGER_MM = -1.15
"""Tap is pushed up by so much until it triggers."""
PROBE_C = 40
"""In the place of 150: heating takes as long as it does."""
EXTRUDER = {
    "step_pin": "toolhead:PA0",
    "dir_pin": "toolhead:PA1",
    "rotation_distance": 22.5,
    "microsteps": 16,
    "nozzle_diameter": 0.4,
    "filament_diameter": 1.75,
    "heater_pin": "toolhead:PA4",
    "control": "pid",
    "sensor_type": "EPCOS 100K B57560G104F",
    "sensor_pin": "toolhead:PA3",
    "min_temp": 0,
    "max_temp": 300,
    "pid_Kp": 10,
    "pid_Ki": 0.2,
    "pid_Kd": 10,
    "max_power": 0.1,
}


def published_lines() -> str:
    """Return activate_gcode of Tap's configuration."""
    path = REAL / TAP
    if not path.exists():
        pytest.skip(f"{path.name} is not beside the checkout")
    _, _, rest = path.read_text().partition("\nactivate_gcode:\n")
    lines, _, _ = rest.partition("\n\nx_offset")
    return "\n" + lines.rstrip().replace("PROBE_TEMP = 150", f"PROBE_TEMP = {PROBE_C}")


@pytest.mark.skipif(not is_full(), reason="thorough only: a real Tap is homed in test_real_levelling.py")
def test_a_nozzle_that_is_too_hot_cools_before_it_touches_the_bed(tmp_path: Path) -> None:
    options: dict[str, Any] = {"x_offset": 0, "y_offset": 0, "z_offset": TRIGGER_MM}
    options["activate_gcode"] = published_lines()
    text = machine_text(sections=section("extruder", **EXTRUDER), **options)
    heat = HeatSettings(hurry=10, warm_c={"extruder": 60})
    stage = ProbeStage(tmp_path, text, bed=TILTED, heat=heat)
    cool_at: list[float] = []
    stage.when(
        lambda: stage.true_mm("z") < 7.5, lambda: cool_at.append(stage.true_c("extruder")), look_s=0.05
    )
    output = stage.do(
        *("G28", "G1 Z5 F900", "G1 X80 Y40 F9000", "M104 S60", "PROBE SAMPLES=2", "G1 Z5"),
        *("G1 X0 Y0 F9000", "PROBE"),
    )
    assert cool_at[0] < PROBE_C + 5 + 1
    assert any("is still too high, waiting until below" in text for text in output), output
    assert any(f"target of 60.0C is too high, lowering to {PROBE_C}.0C" in text for text in output)
    tilt = bed_height(TILTED.shape, 80, 40) - bed_height(TILTED.shape, 0, 0)
    first, _, last = heights(output)
    assert first == pytest.approx(TRIGGER_MM + tilt, abs=MICROSTEP_MM)
    assert last == pytest.approx(TRIGGER_MM, abs=MICROSTEP_MM)
    found = [re.fullmatch(r"Result is .*: the bed is at z=(\S+) at (\S+)", text) for text in output]
    places = {match[2]: float(match[1]) for match in found if match is not None}
    assert places["80.000,40.000"] == pytest.approx(tilt, abs=MICROSTEP_MM), "the nozzle is the probe"

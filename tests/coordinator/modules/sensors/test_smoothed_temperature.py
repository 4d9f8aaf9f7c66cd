"""Temperatures that something is corrected by: a reading that cannot be does not move Z, nor a threshold."""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from coordinator.assembly.load import load_machine
from coordinator.modules.compensation.z_thermal_adjust import MOST_MM, ZThermalAdjust
from coordinator.modules.eddy_current.coil_drift import HEIGHTS
from coordinator.modules.eddy_current.temperature_probe import TemperatureProbe
from coordinator.modules.module_set import build_modules
from coordinator.modules.sensors.smoothed_temperature import SmoothedTemperature
from coordinator.modules.sensors.temperature_input import TemperatureInput
from nodes.devices.analog_in import AnalogValue
from nodes.support.errors import CanductorError
from tests.stages.heat_machine import HOTEND_PID, build
from tests.stages.printer_text import section
from tests.stages.probe_stage import machine_text

FRAME = {"sensor_type": "Generic 3950", "sensor_pin": "PC3", "temp_coeff": 0.01}
COIL = {"sensor_type": "Generic 3950", "sensor_pin": "toolhead:PA1", "calibration_temp": 25}
OPEN, SHORT = 1.0, 0.0
"""What the converter reads of a broken wire: -125 °C, and of a shorted one: 10,000 °C."""


class Read:
    """MODULE, whose sensor's readings come from the test, three in a second."""

    def __init__(self, module: SmoothedTemperature) -> None:
        self.said: list[str] = []
        self._at_s = 0.0
        live: Any = SimpleNamespace(say=self.said.append, print_time_of=lambda _node, _clock: self._at_s)
        assert isinstance(module.input, TemperatureInput)
        self._input = module.input
        module._live = module.input._live = live

    def ratio_of(self, celsius: float) -> float:
        assert self._input._sensor is not None
        return self._input._sensor.ratio(celsius)

    def take(self, *ratios: float) -> None:
        for ratio in ratios:
            self._at_s += 0.3
            self._input._came(AnalogValue(ratio, 0))


def frequency(height_mm: float) -> float:
    """Return that of a coil, Hz."""
    return 3e6 * (1 + 0.1 * math.exp(-height_mm / 3))


def frame(folder: Path, **options: object) -> tuple[ZThermalAdjust, Read]:
    """Return a frame of 25 °C at which Z was homed."""
    modules = build(folder, HOTEND_PID + section("z_thermal_adjust", **FRAME, **options))
    module = next(modules.of(ZThermalAdjust))
    read = Read(module)
    read.take(*[read.ratio_of(25.0)] * 30)
    module._homed("XYZ")
    assert module.shift_at(0.2) == 0.0
    return module, read


@pytest.mark.parametrize(
    ("wire", "limits", "said"),
    [
        (OPEN, {}, "reads -125 °C, outside -30 to 150 °C"),
        (SHORT, {}, "reads 10000 °C, outside -30 to 150 °C"),
        (SHORT, {"min_temp": 0, "max_temp": 80}, "reads 10000 °C, outside 0 to 80 °C"),
    ],
)
def test_a_broken_wire_does_not_move_z(
    tmp_path: Path, wire: float, limits: dict[str, object], said: str
) -> None:
    """Failed before: by -13 mm with one reading of a shorted wire, by -75 mm with ten."""
    module, read = frame(tmp_path, **limits)
    for _ in range(10):
        read.take(wire)
        assert module.shift_at(0.2) == 0.0
    read.take(read.ratio_of(25.0), wire)
    assert [sentence.partition(": ")[0] for sentence in read.said] == [f"[z_thermal_adjust] {said}"]
    read.take(*[read.ratio_of(35.0)] * 60)
    assert module.shift_at(0.2) == pytest.approx(-0.1, abs=0.001)


def test_the_correction_is_limited_by_itself(tmp_path: Path) -> None:
    module, read = frame(tmp_path, smooth_time=0)
    read.take(read.ratio_of(149.0))
    assert module.shift_at(0.2) == -MOST_MM
    module, read = frame(tmp_path, smooth_time=0, max_z_adjustment=2)
    read.take(read.ratio_of(149.0))
    assert module.shift_at(0.2) == pytest.approx(-1.24, abs=0.001)


def test_limits_that_are_not_given_stop_no_machine(tmp_path: Path) -> None:
    """A node, or the host for a sensor without a pin, stops it only where the user has said so."""
    for limits, guarded in (({}, False), ({"max_temp": 80}, True)):
        for sensor in (FRAME, {"sensor_type": "temperature_host", "sensor_path": tmp_path / "temp"}):
            modules = build(tmp_path, HOTEND_PID + section("z_thermal_adjust", **sensor, **limits))
            assert next(modules.of(ZThermalAdjust)).input.guarded is guarded


def test_a_coil_whose_sensor_is_broken_does_not_probe(tmp_path: Path) -> None:
    """Failed before: the threshold of the probe followed what the sensor read."""
    table = ", ".join(f"{mm / 20:g}:{frequency(mm / 20):.3f}" for mm in range(1, 81))
    drift = "\n  " + "\n  ".join(
        f"{mm:g}: {frequency(mm):.6f}, {frequency(mm) * 1e-4:.9f}, 0" for mm in HEIGHTS
    )
    own = section("temperature_probe coil", **COIL, drift_calibration=drift, drift_calibration_min_temp=20)
    path = tmp_path / "probe.cfg"
    path.write_text(machine_text(kind="probe_eddy_current coil", calibrate=table, sections=own))
    module = next(build_modules(load_machine(str(path))).of(TemperatureProbe))
    read = Read(module)
    read.take(*[read.ratio_of(25.0)] * 5)
    assert module.to_calibrated(3.2e6) == pytest.approx(3.2e6)
    read.take(SHORT)
    assert module.celsius is None
    with pytest.raises(CanductorError, match="measures no temperature, by which the coil is corrected"):
        module.from_calibrated(3.2e6)
    read.take(read.ratio_of(25.0))
    assert module.from_calibrated(3.2e6) == pytest.approx(3.2e6)

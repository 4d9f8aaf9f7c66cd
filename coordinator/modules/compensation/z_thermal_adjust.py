"""[z_thermal_adjust]: Z is corrected for a frame that grows as it gets warm.

The height that counts is that at which Z was homed: from there on Z is lowered by temp_coeff for each degree.
The correction is part of each move that is planned; nothing moves for its sake alone.
"""

from collections.abc import Mapping
from typing import ClassVar, Final

from coordinator.config.options import FloatOption, SectionSpec
from coordinator.config.sections.sensor_options import (
    FREE_SENSOR_OPTIONS,
    SENSOR_OPTIONS,
    UNSUPPORTED_SENSOR_OPTIONS,
)
from coordinator.gcode.commands import Call, Immediate, Reading
from coordinator.gcode.parameters import bounded, flag
from coordinator.modules.base import Build, Modules
from coordinator.modules.homing.homing import Homing
from coordinator.modules.sensors.smoothed_temperature import LIMITS, SMOOTH_TIME, SmoothedTemperature
from coordinator.modules.sensors.temperature_sensor import GCODE_ID
from coordinator.support.values import Value

STEEPEST: Final = 1.0
"""mm/K."""
ANY_MM: Final = 99_999_999.0
MOST_MM: Final = 1.0
"""A frame of steel or aluminium that is 1 m high grows by that much in 40 to 80 K."""
COLDEST_C: Final = -273.15
HOTTEST_C: Final = 1000.0
LEAST_MM: Final = 5e-4
"""A smaller change is no step of most machines, and waits until it is larger."""

TEMP_COEFF: Final = FloatOption(
    name="temp_coeff",
    help="by how much Z is lowered for each degree; 0: not at all",
    default=0.0,
    unit="mm/K",
    minimum=-STEEPEST,
    maximum=STEEPEST,
)
OFF_ABOVE: Final = FloatOption(
    name="z_adjust_off_above",
    help="above this Z the correction stays as it is",
    default=ANY_MM,
    unit="mm",
    minimum=0,
    maximum=ANY_MM,
)
MOST: Final = FloatOption(
    name="max_z_adjustment",
    help="largest correction, up or down",
    default=MOST_MM,
    unit="mm",
    minimum=0,
    maximum=ANY_MM,
)


class ZThermalAdjust(SmoothedTemperature):
    """The section."""

    NAMED: ClassVar = False
    SPEC: ClassVar = SectionSpec(
        help=f"Corrects Z for a frame that grows with its temperature; {LIMITS}",
        options=(
            *(TEMP_COEFF, SMOOTH_TIME, OFF_ABOVE, MOST),
            *(*SENSOR_OPTIONS, *FREE_SENSOR_OPTIONS, GCODE_ID),
        ),
        unsupported=UNSUPPORTED_SENSOR_OPTIONS,
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._coeff = build.get(TEMP_COEFF)
        self._off_above, self._most = build.get(OFF_ABOVE), build.get(MOST)
        self._enabled = True
        self._reference_c: float | None = None
        """When Z was homed; None: it was not."""
        self._shift_mm = 0.0
        build.z_shift = self.shift_at
        build.add_command(
            "SET_Z_THERMAL_ADJUST",
            "Set the correction for the frame's temperature: ENABLE, TEMP_COEFF, REF_TEMP; or report it",
            self._read,
            while_printing=True,
        )

    def link(self, modules: Modules) -> None:
        """Find the sensor, and hear of homing."""
        super().link(modules)
        for homing in modules.of(Homing):
            homing.when_homed.append(self._homed)

    def status(self) -> Mapping[str, Value]:
        """Report the correction, mm, the temperature that it is of, and the one that Z was homed at, °C."""
        reference = self._reference_c
        return {
            **super().status(),
            "enabled": self._enabled,
            "current_z_adjust": self._shift_mm,
            "z_adjust_ref_temperature": None if reference is None else round(reference, 2),
        }

    def shift_at(self, z_mm: float) -> float:
        """Return how much higher Z has to be for what is planned next at Z_MM; in the reader's thread."""
        reference, smoothed = self._reference_c, self._smoothed.value
        if self._enabled and reference is not None and smoothed is not None and z_mm <= self._off_above:
            wanted = -self._coeff * (smoothed - reference)
            wanted = min(max(wanted, -self._most), self._most)
            if abs(wanted - self._shift_mm) >= LEAST_MM:
                self._shift_mm = wanted
        return self._shift_mm

    def _homed(self, axes: str) -> None:
        if "Z" in axes:
            self._shift_mm = 0.0
            self._reference_c = self._smoothed.value

    def _read(self, call: Call) -> Reading:
        command, given = call.command, call.parameters("ENABLE", "TEMP_COEFF", "REF_TEMP")
        enabled = flag(command, given, "ENABLE") if "ENABLE" in given else self._enabled
        coeff = bounded(command, given, "TEMP_COEFF", self._coeff, low=-STEEPEST, high=STEEPEST)
        reference = self._reference_c
        if "REF_TEMP" in given:
            reference = bounded(command, given, "REF_TEMP", 0.0, low=COLDEST_C, high=HOTTEST_C)
        shown = "not known, as Z is not homed" if reference is None else f"{reference:.2f} °C"

        def act() -> None:
            self._enabled, self._coeff, self._reference_c = enabled, coeff, reference

        report = (
            f"enabled: {enabled}, temp_coeff: {coeff:g} mm/K, reference: {shown},"
            f" correction: {self._shift_mm:.4f} mm"
        )
        return Immediate((report,), act)

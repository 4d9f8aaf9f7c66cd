"""[temperature_probe NAME]: how warm the coil of [probe_eddy_current NAME] is, and what follows from that.

Frequencies are corrected to the temperature at which the table of the coil was calibrated, by what
TEMPERATURE_PROBE_CALIBRATE has found. Without a coil of that name it is a sensor that only reports.
"""

from collections.abc import Mapping
from typing import ClassVar, Final

from coordinator.config.errors import ConfigError
from coordinator.config.options import FloatOption, SectionSpec
from coordinator.config.sections.sensor_options import (
    FREE_SENSOR_OPTIONS,
    SENSOR_OPTIONS,
    UNSUPPORTED_SENSOR_OPTIONS,
)
from coordinator.modules.base import Build, Modules
from coordinator.modules.eddy_current.coil_drift import CoilDrift, DriftOption
from coordinator.modules.eddy_current.drift_calibration import (
    BED_TEMP,
    EXTRUDER_TEMP,
    PROCEDURE_OPTIONS,
    DriftCalibration,
    procedure_of,
)
from coordinator.modules.eddy_current.eddy_probe import EddyProbe
from coordinator.modules.sensors.smoothed_temperature import LIMITS, SMOOTH_TIME, SmoothedTemperature
from coordinator.modules.sensors.temperature_sensor import GCODE_ID
from coordinator.support.values import Value
from nodes.support.errors import CanductorError

CALIBRATED: Final = FloatOption(
    name="calibration_temp",
    help="of the coil when PROBE_EDDY_CURRENT_CALIBRATE measured; that saves it",
    unit="°C",
    minimum=-100,
    maximum=500,
)
DRIFT: Final = DriftOption(
    name="drift_calibration",
    help="frequencies by temperature and height; TEMPERATURE_PROBE_CALIBRATE finds them",
)
LOWEST: Final = FloatOption(
    name="drift_calibration_min_temp",
    help="lowest temperature of that calibration; what is colder is corrected as if it were that warm",
    unit="°C",
    minimum=-100,
    maximum=500,
)


class TemperatureProbe(SmoothedTemperature):
    """The section."""

    SPEC: ClassVar = SectionSpec(
        help=f"The temperature of the coil of [probe_eddy_current NAME], which corrects its drift; {LIMITS}",
        options=(
            *(SMOOTH_TIME, *PROCEDURE_OPTIONS, CALIBRATED, DRIFT, LOWEST),
            *(*SENSOR_OPTIONS, *FREE_SENSOR_OPTIONS, GCODE_ID),
        ),
        unsupported=UNSUPPORTED_SENSOR_OPTIONS,
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.instance = build.instance
        self._place = build.place
        self.procedure = procedure_of(build)
        self._calibrated_c = build.find(CALIBRATED)
        self._drift = build.find(DRIFT)
        self._lowest_c = build.find(LOWEST)
        if self._drift is not None and not self._drift.is_plausible(
            self._lowest_c or 0.0, self.procedure.valid_c
        ):
            raise build.reader.bad(
                DRIFT, "which is not plausible up to max_validation_temp; calibrate again, or remove it"
            )
        self._enabled = True
        self._probe: EddyProbe | None = None
        self._calibration = build.shared(DriftCalibration)

    def link(self, modules: Modules) -> None:
        """Find the coil; raises ConfigError."""
        super().link(modules)
        for option, celsius, heater in (
            (BED_TEMP, self.procedure.bed_c, "heater_bed"),
            (EXTRUDER_TEMP, self.procedure.extruder_c, "extruder"),
        ):
            if celsius and "heater_pin" not in modules.config.get(heater, {}):
                raise ConfigError(
                    self._place,
                    f"{option.name} of [{self.name}] needs a heater in [{heater}], and there is none",
                )
        self._probe = modules.find(f"probe_eddy_current {self.instance}", EddyProbe)
        if self._probe is not None:
            self._probe.compensation = self
            self._calibration.coil = self

    @property
    def probe(self) -> EddyProbe:
        """The probe whose coil it is in."""
        assert self._probe is not None
        return self._probe

    def status(self) -> Mapping[str, Value]:
        """Report the temperature, and whether it corrects or calibrates."""
        return {
            **super().status(),
            "in_calibration": self._probe is not None and self._calibration.is_going_on,
            "compensation_enabled": self._probe is not None and self._enabled and self._drift is not None,
        }

    def _measured(self, at_s: float, celsius: float) -> None:
        super()._measured(at_s, celsius)
        if self._probe is not None and self.input.is_sound:
            self._calibration.measured(celsius)

    # ------------------------------------------------------------------------------------------ correcting

    def to_calibrated(self, frequency_hz: float) -> float:
        """Return what a frequency of now would have been when the table was calibrated, Hz."""
        return self._adapted(frequency_hz, to_table=True)

    def from_calibrated(self, frequency_hz: float) -> float:
        """Return what a frequency of the table would be now, Hz."""
        return self._adapted(frequency_hz, to_table=False)

    def _adapted(self, frequency_hz: float, *, to_table: bool) -> float:
        """Return a frequency at the other temperature; raises CanductorError."""
        drift, table_c = self._drift, self._calibrated_c
        if drift is None or table_c is None or not self._enabled:
            return frequency_hz
        now_c = self._smoothed.value
        if now_c is None or self.celsius is None:
            raise CanductorError(
                f"[{self.name}] measures no temperature, by which the coil is corrected: check its sensor, or"
                " send TEMPERATURE_PROBE_ENABLE ENABLE=0"
            )
        if self._lowest_c is not None:
            now_c = max(now_c, self._lowest_c)
        from_c, to_c = (now_c, table_c) if to_table else (table_c, now_c)
        return drift.adapted(frequency_hz, from_c, to_c)

    def table_calibrated(self) -> None:
        """Keep the temperature at which the table is calibrated."""
        if (celsius := self._smoothed.value) is not None:
            self._calibrated_c = celsius
            self.live.save(self.name, CALIBRATED.name, f"{celsius:.2f}")

    def keep(self, drift: CoilDrift, lowest_c: float) -> bool:
        """Correct by DRIFT from now on; return whether it is known at which temperature heights are right."""
        self._drift, self._lowest_c = drift, lowest_c
        self.live.save(self.name, DRIFT.name, drift.text())
        self.live.save(self.name, LOWEST.name, f"{lowest_c:.2f}")
        return self._calibrated_c is not None

    def enable(self, *, enabled: bool) -> None:
        """Correct, or do not; raises CanductorError where no drift is known."""
        if enabled and self._drift is None:
            raise CanductorError(
                f"[{self.name}] is not calibrated: calibrate with TEMPERATURE_PROBE_CALIBRATE"
            )
        self._enabled = enabled

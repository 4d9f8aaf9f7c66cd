"""A temperature that something is corrected by: only sound readings count, and they are smoothed."""

from typing import ClassVar, Final

from coordinator.config.options import FloatOption, SectionSpec
from coordinator.modules.base import Build
from coordinator.modules.sensors.temperature_sensor import TemperatureSensor
from coordinator.support.low_pass import LowPass

COLDEST_C: Final = -30.0
HOTTEST_C: Final = 150.0
"""Of frames and coils. A thermistor whose wire is open reads less, one that is shorted more."""
LIMITS: Final = (
    f"readings outside min_temp (by default {COLDEST_C:g}) and max_temp ({HOTTEST_C:g}) do not count"
)

SMOOTH_TIME: Final = FloatOption(
    name="smooth_time",
    help="time constant of the low pass that the temperature goes through first",
    default=2.0,
    unit="s",
    minimum=0,
    maximum=3600,
)


class SmoothedTemperature(TemperatureSensor):
    """A sensor by whose temperature something is corrected; it has SMOOTH_TIME among its options."""

    SPEC: ClassVar = SectionSpec(help="", options=())
    PLAUSIBLE: ClassVar = (COLDEST_C, HOTTEST_C)

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._smoothed = LowPass(build.get(SMOOTH_TIME))
        self._reported = False

    @property
    def celsius(self) -> float | None:
        """The last reading; None: there is none, or it is not sound."""
        return self.input.celsius if self.input.is_sound else None

    def _measured(self, at_s: float, celsius: float) -> None:
        super()._measured(at_s, celsius)
        if self.input.is_sound:
            self._smoothed.take(at_s, celsius)
        elif not self._reported:
            self._reported = True
            self.live.say(
                f"[{self.name}] reads {celsius:.0f} °C, outside {self.input.min_c:g} to"
                f" {self.input.max_c:g} °C: such readings do not count; check its sensor and the wires"
            )

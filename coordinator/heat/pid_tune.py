"""PID constants from a heater's own swing: the relay method of Åström and Hägglund.

The heater is switched fully on below the target and off above it. The temperature then swings around the
target; from height and length of the swing follow the ultimate gain and period, and from those the constants
by Ziegler and Nichols' classic rule: Kp = 0.6 Ku, Ti = Tu / 2, Td = Tu / 8.
"""

import math
from dataclasses import dataclass, field
from typing import Final

from coordinator.heat.pid import PARAMETER_BASE, PidGains
from nodes.support.errors import CanductorError

SWINGS: Final = 5
"""Whole swings that count, after the first, which begins cold."""
HYSTERESIS_K: Final = 0.5
"""The heater is switched this far beyond the target, so that noise does not switch it."""
FIRST_PEAK_S: Final = 3600.0
SWING_S: Final = 600.0
"""A heater that takes longer than these cannot be tuned like this."""


class TuneError(CanductorError):
    """A heater could not be tuned; the sentence says why and what to do."""


@dataclass(slots=True)
class _Swing:
    """From one switching on to the next."""

    began_s: float
    low_c: float
    high_c: float


@dataclass(slots=True)
class RelayTune:
    """Swings a heater around TARGET_C with 0 and MAX_POWER; when ``gains`` is there it is done.

    Call ``power`` with every measurement, as a controller. Raises TuneError when there is no swing.
    """

    target_c: float
    max_power: float = 1.0
    gains: PidGains | None = None
    _heating: bool = True
    _began_s: float | None = None
    _swings: list[_Swing] = field(default_factory=list)

    def power(self, now_s: float, measured_c: float, target_c: float = 0.0) -> float:
        """Return the power from now on; the target is that of the construction."""
        del target_c
        if self.gains is not None:
            return 0.0
        if self._began_s is None:
            self._began_s = now_s
        self._look_at(now_s, measured_c)
        if self._heating and measured_c >= self.target_c + HYSTERESIS_K:
            self._heating = False
        elif not self._heating and measured_c <= self.target_c - HYSTERESIS_K:
            self._heating = True
            self._swings.append(_Swing(now_s, measured_c, measured_c))
            if len(self._swings) > SWINGS + 1:
                self.gains = self._result()
        return self.max_power if self._heating and self.gains is None else 0.0

    @property
    def is_done(self) -> bool:
        """Whether it is done."""
        return self.gains is not None

    def _look_at(self, now_s: float, measured_c: float) -> None:
        assert self._began_s is not None
        if self._swings:
            swing = self._swings[-1]
            swing.low_c = min(swing.low_c, measured_c)
            swing.high_c = max(swing.high_c, measured_c)
        since_s = now_s - (self._swings[-1].began_s if self._swings else self._began_s)
        limit_s = SWING_S if self._swings else FIRST_PEAK_S
        if since_s > limit_s:
            raise TuneError(
                f"the temperature does not swing around {self.target_c:g} °C ({measured_c:.1f} °C after "
                f"{since_s:.0f} s); check heater and sensor, or choose a target the heater can reach"
            )

    def _result(self) -> PidGains:
        counted = self._swings[:-1][-SWINGS:]
        ends = [*(swing.began_s for swing in counted[1:]), self._swings[-1].began_s]
        period_s = sum(end - swing.began_s for swing, end in zip(counted, ends, strict=True)) / len(counted)
        amplitude = sum((swing.high_c - swing.low_c) / 2 for swing in counted) / len(counted)
        if amplitude <= 0 or period_s <= 0:
            raise TuneError("the temperature does not swing; check the sensor")
        ultimate = 4 * (self.max_power / 2) / (math.pi * amplitude)
        kp = 0.6 * ultimate * PARAMETER_BASE
        return PidGains(kp, kp / (period_s / 2), kp * period_s / 8)

    @property
    def watched_c(self) -> float:
        """What the watch over the heater takes for its target."""
        return self.target_c

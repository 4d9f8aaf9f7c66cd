"""PID control of a heater."""

from dataclasses import dataclass
from typing import Final

from coordinator.heat.controller import NEAR_K, SLOW_K_PER_S, Slope

PARAMETER_BASE: Final = 255.0
"""Users' pid_Kp, pid_Ki and pid_Kd stand for a power of 0 to 255."""
LONGEST_STEP_S: Final = 2.0
"""Of a longer gap between measurements the integral takes no more than this."""


@dataclass(frozen=True, slots=True)
class PidGains:
    """As users write them: per K, per K·s and per K/s, for a power of 0 to 255."""

    kp: float
    ki: float
    kd: float


class Pid:
    """Power from the error, its integral and the slope of the measurement, smoothed over SMOOTH_S.

    The slope is not that of the error, so that a new target gives no kick.
    The integral stands still while the power is at its limit and the error would push it further (no
    wind-up), and never stands for more than MAX_POWER or less than nothing.
    """

    def __init__(self, gains: PidGains, *, max_power: float = 1.0, smooth_s: float = 1.0) -> None:
        self.gains = gains
        self._kp, self._ki, self._kd = (g / PARAMETER_BASE for g in (gains.kp, gains.ki, gains.kd))
        self._max_power = max_power
        self._slope = Slope(smooth_s)
        self._integral_power = 0.0

    def power(self, now_s: float, measured_c: float, target_c: float) -> float:
        """Return the power from now on."""
        elapsed_s = min(self._slope.update(now_s, measured_c), LONGEST_STEP_S)
        if target_c <= 0:
            self._integral_power = 0.0
            return 0.0
        error = target_c - measured_c
        fast = self._kp * error - self._kd * self._slope.k_per_s
        wanted = fast + self._integral_power
        further = (wanted >= self._max_power and error > 0) or (wanted <= 0 and error < 0)
        if not further:
            grown = self._integral_power + self._ki * error * elapsed_s
            self._integral_power = min(max(grown, 0.0), self._max_power)
        return min(max(fast + self._integral_power, 0.0), self._max_power)

    @property
    def held(self) -> tuple[Slope, float]:
        """What it has gathered: the slope of the temperature, and the power that holds it."""
        return self._slope, self._integral_power

    def go_on_from(self, before: "Pid") -> None:
        """Take over from another one, with other gains, without a jump of what is held."""
        self._slope, self._integral_power = before.held

    def settled(self, measured_c: float, target_c: float) -> bool:
        """Return whether the target is reached and held."""
        return abs(target_c - measured_c) <= NEAR_K and abs(self._slope.k_per_s) <= SLOW_K_PER_S

"""The check that a heater heats as commanded.

Three faults are found: it does not come nearer to a target (loose or broken heater, sensor fallen out), it
does not hold one, and it still heats long after it was switched off (a switch that is stuck).
"""

from dataclasses import dataclass
from typing import Final

OFF_BEFORE_S: Final = 30.0
"""How long a heater must have been off before its heat cannot be what is left in it."""
STUCK_GAINS: Final = 3
"""A heater that is off and gets hotter by so many heating_gain within check_gain_time is stuck on.

An extruder above a bed that heats up gets warmer too, but not by 6 K in 20 s."""
LONGEST_STEP_S: Final = 5.0
"""Of a longer gap between looks the error takes no more than this."""


@dataclass(frozen=True, slots=True)
class VerifyOptions:
    """As users write them; the defaults are those of a hot end."""

    max_error_ks: float = 120.0
    """How much K·s below the range of the target may gather."""
    check_gain_s: float = 20.0
    """While heating up: the temperature has to rise by the gain in every such time."""
    hysteresis_k: float = 5.0
    """This near to the target is in range."""
    heating_gain_k: float = 2.0


GAIN_TIME_S: Final = 20.0
BED_GAIN_TIME_S: Final = 60.0


def default_options(heater: str) -> VerifyOptions:
    """Return the options of a heater that has no [verify_heater] section."""
    return VerifyOptions(check_gain_s=BED_GAIN_TIME_S if heater == "heater_bed" else GAIN_TIME_S)


class HeaterCheck:
    """Watches one heater; call ``check`` with every measurement, or at least every second."""

    def __init__(self, options: VerifyOptions) -> None:
        self.options = options
        self.error_ks = 0.0
        """What has gathered below the range, K·s."""
        self._target_c = 0.0
        self._reached = False
        self._goal_c = 0.0
        self._goal_by_s = 0.0
        self._last_s: float | None = None
        self._off_since_s: float | None = None
        self._coolest: tuple[float, float] = (0.0, 0.0)

    def check(self, now_s: float, measured_c: float, target_c: float, power: float) -> str | None:
        """Return what is wrong, to follow the heater's name, or None.

        POWER is what is applied to the heater up to now.
        """
        elapsed_s = 0.0 if self._last_s is None else min(max(now_s - self._last_s, 0.0), LONGEST_STEP_S)
        self._last_s = now_s
        stuck = None
        if power > 0:
            self._off_since_s = None
        else:
            stuck = self._check_stuck(now_s, measured_c)
        if target_c <= 0:
            self._target_c = self.error_ks = 0.0
            self._reached = False
            return stuck
        if target_c != self._target_c:
            self._begin(now_s, measured_c, target_c)
        if measured_c >= target_c - self.options.hysteresis_k:
            self._reached = True
            self.error_ks = 0.0
            return stuck
        if self._reached:
            return self._hold(measured_c, target_c, elapsed_s)
        return self._approach(now_s, measured_c, target_c)

    def _begin(self, now_s: float, measured_c: float, target_c: float) -> None:
        """Take a new target: one above has to be approached, one below is reached.

        A target that was not reached yet is checked from where its check began: a program that changes the
        target more often than the temperature is measured must not put the check off again and again.
        """
        approaching = self._target_c > 0 and not self._reached
        self._target_c = target_c
        self._reached = measured_c >= target_c - self.options.hysteresis_k
        self.error_ks = 0.0
        if not approaching:
            self._set_goal(now_s, measured_c)

    def _set_goal(self, now_s: float, measured_c: float) -> None:
        self._goal_c = measured_c + self.options.heating_gain_k
        self._goal_by_s = now_s + self.options.check_gain_s

    def _approach(self, now_s: float, measured_c: float, target_c: float) -> str | None:
        if measured_c >= self._goal_c:
            self._set_goal(now_s, measured_c)
            return None
        if now_s < self._goal_by_s:
            # While it falls at first (the target was raised while it cooled) the gain counts from the bottom.
            self._goal_c = min(self._goal_c, measured_c + self.options.heating_gain_k)
            return None
        options = self.options
        return (
            f"is at {measured_c:.1f} °C and did not get {options.heating_gain_k:g} K nearer to "
            f"{target_c:g} °C in {options.check_gain_s:g} s; check heater, sensor and their wires"
        )

    def _hold(self, measured_c: float, target_c: float, elapsed_s: float) -> str | None:
        self.error_ks += (target_c - self.options.hysteresis_k - measured_c) * elapsed_s
        if self.error_ks < self.options.max_error_ks:
            return None
        return (
            f"does not hold {target_c:g} °C: it fell to {measured_c:.1f} °C ({self.error_ks:.0f} K·s below "
            f"its range of {self.options.hysteresis_k:g} K); check heater, sensor and what cools them"
        )

    def _check_stuck(self, now_s: float, measured_c: float) -> str | None:
        if self._off_since_s is None:
            self._off_since_s = now_s
        options = self.options
        begin_s, coolest_c = self._coolest
        just_off = now_s - self._off_since_s < OFF_BEFORE_S
        if just_off or measured_c <= coolest_c or now_s - begin_s > options.check_gain_s:
            self._coolest = now_s, measured_c
        elif measured_c - coolest_c >= STUCK_GAINS * options.heating_gain_k:
            return (
                f"heats though it is off: it rose from {coolest_c:.1f} to {measured_c:.1f} °C in "
                f"{now_s - begin_s:.0f} s; its switch is stuck, cut its power"
            )
        return None

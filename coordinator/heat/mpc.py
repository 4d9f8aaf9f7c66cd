"""Model-predictive control of a heater: power is computed from what the heater is.

The model: a block of CAPACITY takes power and loses heat to the surroundings (more with the fan on) and into
filament that passes; the sensor follows the block with a lag. An observer corrects block and sensor with
every measurement. What the model cannot explain (another ambient temperature, a supply voltage 5 % off) it
learns as a flow of heat, so that the temperature settles on the target.

Observer gains: errors of block temperature (e_b), sensor temperature (e_s) and unexplained heat (e_d) follow
    e_s' = k e_b - (k + L_s) e_s      e_b' = -λ e_b + e_d / C - L_b e_s      e_d' = -L_d e_s
with k the sensor's responsiveness and λ = transfer / C. All three poles are put at -w, with w =
OBSERVER_SPEED · k: fast against the sensor's lag, yet not so fast that noise is taken for heat.
"""

import math
from dataclasses import dataclass
from typing import Final

from coordinator.heat.controller import NEAR_K, SLOW_K_PER_S, Slope

OBSERVER_SPEED: Final = 1.5
OBSERVER_FASTEST_PER_S: Final = 1.0
LONGEST_STEP_S: Final = 2.0
STEP_S: Final = 0.1
"""The model is computed in steps of at most this."""
UNEXPLAINED_PART: Final = 0.5
"""Of the heater's power: more than this is no unexplained heat but a broken heater, for others to find."""
DEFAULT_AMBIENT_C: Final = 25.0


@dataclass(frozen=True, slots=True, kw_only=True)
class HeaterModel:
    """What a heater is; from MPC_CALIBRATE."""

    power_w: float
    """At full power."""
    capacity_j_per_k: float
    transfer_w_per_k: float
    """Loss to the surroundings without fan."""
    responsiveness_per_s: float
    """How fast the sensor follows the block: K/s per K of difference."""
    fan_transfer_w_per_k: tuple[float, ...] = ()
    """Loss with the fan at speeds spread evenly over 0..1; the first is the one without fan."""
    filament_j_per_mm_k: float = 0.0
    """Heat that a mm of filament takes per K."""

    def transfer_at(self, fan_speed: float) -> float:
        """Return the loss, W/K, with the fan at 0..1."""
        transfers = self.fan_transfer_w_per_k
        if len(transfers) < 2:
            return self.transfer_w_per_k
        place = min(max(fan_speed, 0.0), 1.0) * (len(transfers) - 1)
        index = min(int(place), len(transfers) - 2)
        return transfers[index] + (place - index) * (transfers[index + 1] - transfers[index])


def filament_heat(diameter_mm: float, density_g_per_cm3: float, heat_capacity_j_per_g_k: float) -> float:
    """Return what a mm of filament takes, J/(mm·K)."""
    return math.pi * (diameter_mm / 2) ** 2 / 1000 * density_g_per_cm3 * heat_capacity_j_per_g_k


@dataclass(slots=True)
class _Estimate:
    block_c: float
    sensor_c: float
    unexplained_w: float


class Mpc:
    """Controls the heater that MODEL describes so that the block reaches its target REACH_S later.

    Unexplained heat is learned only while what is measured changes by less than STEADY_K_PER_S and the
    power is not at its limit.
    """

    def __init__(
        self,
        model: HeaterModel,
        *,
        max_power: float = 1.0,
        reach_s: float = 2.0,
        steady_k_per_s: float = 0.5,
    ) -> None:
        self.model = model
        self._max_power = max_power
        self._reach_s = reach_s
        self._steady_k_per_s = steady_k_per_s
        self._slope = Slope(1.0)
        self._fan_speed = 0.0
        self._filament_mm_per_s = self._coming_mm_per_s = 0.0
        self._ambient_c: float | None = None
        self._estimate: _Estimate | None = None
        self._power_w = 0.0
        k, capacity = model.responsiveness_per_s, model.capacity_j_per_k
        w = min(OBSERVER_SPEED * k, OBSERVER_FASTEST_PER_S)
        loss = model.transfer_w_per_k / capacity
        self._to_sensor = 3 * w - k - loss
        self._to_block = (3 * w**2 - (3 * w - loss) * loss) / k
        self._to_heat = w**3 * capacity / k

    # ------------------------------------------------------------------------------------------ disturbances

    def set_fan(self, speed: float) -> None:
        """Set the speed of the fan that cools the block, 0..1."""
        self._fan_speed = speed

    def set_filament(self, mm_per_s: float, coming_mm_per_s: float | None = None) -> None:
        """Set how fast filament has passed since the last measurement, and how fast it is going to.

        None: as much. What is pulled back takes no heat.
        """
        self._filament_mm_per_s = max(mm_per_s, 0.0)
        coming = mm_per_s if coming_mm_per_s is None else coming_mm_per_s
        self._coming_mm_per_s = max(coming, 0.0)

    def set_ambient(self, celsius: float) -> None:
        """Set the ambient temperature, where a sensor measures it."""
        self._ambient_c = celsius

    # ----------------------------------------------------------------------------------------------- control

    def power(self, now_s: float, measured_c: float, target_c: float) -> float:
        """Return the power from now on."""
        elapsed_s = min(self._slope.update(now_s, measured_c), LONGEST_STEP_S)
        if self._estimate is None:
            # Cold at the first look unless it is clearly hot: the best guess of what is around it.
            if self._ambient_c is None:
                self._ambient_c = min(measured_c, DEFAULT_AMBIENT_C)
            self._estimate = _Estimate(measured_c, measured_c, 0.0)
        self._observe(self._estimate, elapsed_s, measured_c)
        if target_c <= 0:
            self._power_w = 0.0
        else:
            flow = self._flow_w(self._estimate, self._coming_mm_per_s)
            rise_w = self.model.capacity_j_per_k * (target_c - self._estimate.block_c) / self._reach_s
            full_w = self._max_power * self.model.power_w
            self._power_w = min(max(rise_w - flow, 0.0), full_w)
        return self._power_w / self.model.power_w

    def settled(self, measured_c: float, target_c: float) -> bool:
        """Return whether the target is reached and held."""
        return abs(target_c - measured_c) <= NEAR_K and abs(self._slope.k_per_s) <= SLOW_K_PER_S

    def _flow_w(self, estimate: _Estimate, mm_per_s: float) -> float:
        """Return the heat that flows to the block in addition to the heater's (negative: it loses).

        MM_PER_S of filament pass.
        """
        ambient = DEFAULT_AMBIENT_C if self._ambient_c is None else self._ambient_c
        transfer = self.model.transfer_at(self._fan_speed)
        transfer += mm_per_s * self.model.filament_j_per_mm_k
        return estimate.unexplained_w - transfer * (estimate.block_c - ambient)

    def _observe(self, estimate: _Estimate, elapsed_s: float, measured_c: float) -> None:
        if elapsed_s <= 0:
            return
        steps = math.ceil(elapsed_s / STEP_S)
        step_s = elapsed_s / steps
        follow = 1 - math.exp(-self.model.responsiveness_per_s * step_s)
        for _ in range(steps):
            rate = (
                self._power_w + self._flow_w(estimate, self._filament_mm_per_s)
            ) / self.model.capacity_j_per_k
            estimate.sensor_c += follow * (estimate.block_c - estimate.sensor_c)
            estimate.block_c += rate * step_s
        surprise = measured_c - estimate.sensor_c
        estimate.sensor_c += min(self._to_sensor * elapsed_s, 1.0) * surprise
        estimate.block_c += self._to_block * elapsed_s * surprise
        # By the measurement: a wrong model would not see that the temperature is steady.
        full = self._power_w >= self._max_power * self.model.power_w
        if abs(self._slope.k_per_s) < self._steady_k_per_s and not full:
            most_w = UNEXPLAINED_PART * self.model.power_w
            learned = estimate.unexplained_w + self._to_heat * elapsed_s * surprise
            estimate.unexplained_w = min(max(learned, -most_w), most_w)

    # ------------------------------------------------------------------------------------------------ status

    @property
    def filament_mm_per_s(self) -> float:
        """What is going to pass."""
        return self._coming_mm_per_s

    @property
    def block_c(self) -> float | None:
        """What the block is thought to have; None before the first measurement."""
        return None if self._estimate is None else self._estimate.block_c

    @property
    def sensor_c(self) -> float | None:
        """What the model expects of the sensor; None before the first measurement."""
        return None if self._estimate is None else self._estimate.sensor_c

    @property
    def ambient_c(self) -> float | None:
        """What is around, unexplained heat taken as warmth of it; None before the first measurement."""
        if self._estimate is None or self._ambient_c is None:
            return None
        return self._ambient_c + self._estimate.unexplained_w / self.model.transfer_at(self._fan_speed)

    @property
    def unexplained_w(self) -> float:
        """Heat that the model does not explain, W."""
        return 0.0 if self._estimate is None else self._estimate.unexplained_w

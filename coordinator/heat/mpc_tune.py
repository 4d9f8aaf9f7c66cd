"""What a heater is, found by heating it: the constants of ``mpc.HeaterModel``.

1. *rest*: the heater is off until its temperature stands still: that is what is around it.
2. *heat*: at full power to the target. Capacity and responsiveness are those whose model fits the rise best.
3. *hold*: at the target, with the fan at each of its speeds in turn, the power that holds it gives the loss.
4. With the losses known the rise is fitted once more.
"""

from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from coordinator.heat.mpc import HeaterModel, Mpc
from coordinator.heat.pid_tune import TuneError
from coordinator.heat.rise import Rise, fit_rise

REST_WINDOW_S: Final = 20.0
REST_K: Final = 0.5
"""At rest: within a window it changed by no more than this."""
HOLD_SETTLE_S: Final = 40.0
"""After a change of the fan, before power counts."""
HOLD_S: Final = 30.0
HOLD_K: Final = 1.0
LIMIT_S: Final = 3600.0
"""No phase may take longer."""


class TunePhase(Enum):
    """Where it is."""

    REST = "rest"
    HEAT = "heat"
    HOLD = "hold"
    DONE = "done"


@dataclass(slots=True)
class MpcTune:
    """Finds the model of a heater of HEATER_W; when ``model`` is there it is done.

    FAN_STEPS: how many fan speeds to measure, 0..1 evenly (0: the heater has no fan); the caller runs the fan
    at ``fan_speed``. Call ``power`` with every measurement. Raises TuneError when something does not come.
    """

    target_c: float
    heater_w: float
    max_power: float = 1.0
    fan_steps: int = 0
    model: HeaterModel | None = None
    phase: TunePhase = TunePhase.REST
    ambient_c: float = 0.0
    fan_speed: float = 0.0
    """What the fan has to run at; 1 while it cools down to rest."""
    _phase_s: float | None = None
    _window: list[tuple[float, float]] = field(default_factory=list)
    _rise: Rise = field(default_factory=Rise)
    _holder: Mpc | None = None
    _hold_s: float = 0.0
    _held: list[float] = field(default_factory=list)
    _powers: list[float] = field(default_factory=list)
    _transfers: list[float] = field(default_factory=list)

    def power(self, now_s: float, measured_c: float, target_c: float = 0.0) -> float:
        """Return the power from now on; the target is that of the construction."""
        del target_c
        if self._phase_s is None:
            self._phase_s = now_s
            self.fan_speed = 1.0 if self.fan_steps else 0.0
        if self.phase is not TunePhase.DONE and now_s - self._phase_s > LIMIT_S:
            raise TuneError(
                f"the heater is at {measured_c:.1f} °C and its phase '{self.phase.value}' did not end in "
                f"{LIMIT_S / 60:.0f} min; check heater and sensor, or choose another target"
            )
        if self.phase is TunePhase.REST:
            return self._rest(now_s, measured_c)
        if self.phase is TunePhase.HEAT:
            return self._heat(now_s, measured_c)
        return self._hold(now_s, measured_c) if self.phase is TunePhase.HOLD else 0.0

    @property
    def is_done(self) -> bool:
        """Whether it is done."""
        return self.model is not None

    def _enter(self, phase: TunePhase, now_s: float) -> None:
        self.phase, self._phase_s = phase, now_s

    def _rest(self, now_s: float, measured_c: float) -> float:
        self._window.append((now_s, measured_c))
        if now_s - self._window[0][0] < REST_WINDOW_S:
            return 0.0
        values = [celsius for _, celsius in self._window]
        half = len(values) // 2
        first, last = sum(values[:half]) / half, sum(values[half:]) / (len(values) - half)
        self._window = [(at, c) for at, c in self._window if at > now_s - REST_WINDOW_S]
        if abs(last - first) > REST_K / 2:
            return 0.0
        self.ambient_c = last
        if self.target_c < self.ambient_c + 20:
            raise TuneError(
                f"the target {self.target_c:g} °C is too near to the {self.ambient_c:.0f} °C the heater has "
                "when off; choose one at least 20 K above"
            )
        self.fan_speed = 0.0
        self._enter(TunePhase.HEAT, now_s)
        return self._heat(now_s, measured_c)

    def _heat(self, now_s: float, measured_c: float) -> float:
        self._rise.add(now_s, measured_c)
        if measured_c < self.target_c:
            return self.max_power
        heat_w = self.max_power * self.heater_w
        found = fit_rise(self._rise, heat_w, self.ambient_c)
        model = HeaterModel(
            power_w=self.heater_w,
            capacity_j_per_k=found.capacity_j_per_k,
            transfer_w_per_k=found.capacity_j_per_k * found.loss_per_s,
            responsiveness_per_s=found.responsiveness_per_s,
        )
        self._holder = Mpc(model, max_power=self.max_power)
        self._holder.set_ambient(self.ambient_c)
        self._enter(TunePhase.HOLD, now_s)
        self._hold_s = now_s
        return self._hold(now_s, measured_c)

    def _hold(self, now_s: float, measured_c: float) -> float:
        assert self._holder is not None
        if abs(measured_c - self.target_c) > HOLD_K and not self._powers:
            self._hold_s = now_s
        power = self._holder.power(now_s, measured_c, self.target_c)
        if now_s - self._hold_s < HOLD_SETTLE_S:
            return power
        self._powers.append(power)
        self._held.append(measured_c)
        if now_s - self._hold_s < HOLD_SETTLE_S + HOLD_S:
            return power
        self._transfers.append(self._held_transfer())
        self._hold_s = now_s
        self._powers.clear()
        self._held.clear()
        if len(self._transfers) < self.fan_steps:
            self.fan_speed = len(self._transfers) / (self.fan_steps - 1)
            return power
        self.fan_speed = 0.0
        self.model = self._result()
        self._enter(TunePhase.DONE, now_s)
        return 0.0

    def _held_transfer(self) -> float:
        """Return the loss: the mean power less what went into changing the temperature."""
        held_c = sum(self._held) / len(self._held)
        power_w = sum(self._powers) / len(self._powers) * self.heater_w
        if held_c - self.ambient_c < 10 or power_w <= 0:
            raise TuneError(
                f"the heater did not hold {self.target_c:g} °C (it has {held_c:.1f} °C); check what cools it"
            )
        return power_w / (held_c - self.ambient_c)

    def _result(self) -> HeaterModel:
        transfer = self._transfers[0]
        heat_w = self.max_power * self.heater_w
        found = fit_rise(self._rise, heat_w, self.ambient_c, transfer_w_per_k=transfer)
        return HeaterModel(
            power_w=self.heater_w,
            capacity_j_per_k=found.capacity_j_per_k,
            transfer_w_per_k=transfer,
            responsiveness_per_s=found.responsiveness_per_s,
            fan_transfer_w_per_k=tuple(self._transfers) if self.fan_steps > 1 else (),
        )

    @property
    def watched_c(self) -> float:
        """What the watch over the heater takes for its target; 0 while it is off."""
        return 0.0 if self.phase is TunePhase.REST else self.target_c

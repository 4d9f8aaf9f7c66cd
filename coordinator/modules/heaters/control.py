"""Which controller a heater's section asks for."""

from dataclasses import replace

from coordinator.config.errors import ConfigError
from coordinator.config.sections.heater_options import (
    AMBIENT_TRANSFER,
    BLOCK_HEAT_CAPACITY,
    CONTROL,
    FAN_TRANSFER,
    FILAMENT_DENSITY,
    FILAMENT_HEAT_CAPACITY,
    HEATER_POWER,
    MAX_DELTA,
    MAX_POWER,
    MPC_OPTIONS,
    PID_KD,
    PID_KI,
    PID_KP,
    PID_OPTIONS,
    SENSOR_RESPONSIVENESS,
    SMOOTH_TIME,
    STEADY_STATE_RATE,
    TARGET_REACH_TIME,
)
from coordinator.heat.controller import Controller
from coordinator.heat.mpc import HeaterModel, Mpc, filament_heat
from coordinator.heat.pid import Pid, PidGains
from coordinator.heat.watermark import Watermark
from coordinator.modules.base import Build


class ControlSettings:
    """The controller that a section asks for, and what tuning needs to make another."""

    def __init__(self, build: Build) -> None:
        """Read the options; those of other controllers are allowed as well."""
        self.kind = build.get(CONTROL)
        self.max_power = build.get(MAX_POWER)
        self.heater_w = build.find(HEATER_POWER)
        self._smooth_s = build.get(SMOOTH_TIME)
        self.max_delta_k = build.get(MAX_DELTA)
        self._reach_s, self._steady = build.get(TARGET_REACH_TIME), build.get(STEADY_STATE_RATE)
        for option in (*PID_OPTIONS, *MPC_OPTIONS):
            build.find(option)
        losses = build.find(FAN_TRANSFER)
        self.fan_transfers = tuple(map(float, losses.split(","))) if losses else ()
        self._build = build
        self._filament_j_per_mm_k = _filament(build)
        self.gains = self._read_gains() if self.kind == "pid" else None
        self._model = self._read_model() if self.kind == "mpc" else None

    def _read_gains(self) -> PidGains:
        return PidGains(*(self._build.get(option) for option in (PID_KP, PID_KI, PID_KD)))

    def _read_model(self) -> HeaterModel | None:
        """Return what MPC_CALIBRATE found; None before that, when the heater can only be calibrated."""
        power = self._build.get(HEATER_POWER)
        values = [self._build.find(o) for o in (BLOCK_HEAT_CAPACITY, AMBIENT_TRANSFER, SENSOR_RESPONSIVENESS)]
        capacity, transfer, responsiveness = values
        if capacity is None and transfer is None and responsiveness is None:
            return None
        if capacity is None or transfer is None or responsiveness is None:
            raise ConfigError(
                self._build.place,
                f"[{self._build.name}] has only some of 'block_heat_capacity', 'ambient_transfer' and"
                " 'sensor_responsiveness'; calibrate it with MPC_CALIBRATE, which gives them all",
            )
        return HeaterModel(
            power_w=power,
            capacity_j_per_k=capacity,
            transfer_w_per_k=transfer,
            responsiveness_per_s=responsiveness,
            fan_transfer_w_per_k=self.fan_transfers,
        )

    def controller(self) -> Controller | None:
        """Return the controller; None for MPC that has yet to be calibrated."""
        if self.gains is not None:
            return self.by_pid(self.gains)
        if self.kind == "mpc":
            return None if self._model is None else self.by_model(self._model)
        return Watermark(max_power=self.max_power, max_delta_k=self.max_delta_k)

    def by_pid(self, gains: PidGains) -> Pid:
        """Return the heater's controller with other gains."""
        return Pid(gains, max_power=self.max_power, smooth_s=self._smooth_s)

    def by_model(self, model: HeaterModel) -> Mpc:
        """Return the heater's controller with another model."""
        model = replace(model, filament_j_per_mm_k=self._filament_j_per_mm_k)
        return Mpc(model, max_power=self.max_power, reach_s=self._reach_s, steady_k_per_s=self._steady)


def _filament(build: Build) -> float:
    """Return what a mm of the filament that passes the heater takes, J/(mm·K); 0: none passes."""
    extruder = next((e for e in build.machine.extruders if e.name == build.name), None)
    if extruder is None:
        return 0.0
    density, capacity = build.get(FILAMENT_DENSITY), build.get(FILAMENT_HEAT_CAPACITY)
    return filament_heat(extruder.filament_diameter, density, capacity)

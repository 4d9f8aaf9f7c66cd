"""Calibrates a heater: runs the tuning, uses the result, and saves and reports it."""

from coordinator.gcode.events import Done
from coordinator.heat.mpc_tune import MpcTune
from coordinator.heat.pid_tune import RelayTune
from coordinator.modules.heaters.heater import Heater

REMARK = "in use from now on; SAVE_CONFIG writes them into the configuration"


async def calibrate_pid(unit: Heater, target_c: float) -> Done:
    """Find the PID constants of a heater around TARGET_C; raises CanductorError."""
    tune = RelayTune(target_c, unit.settings.max_power)
    await unit.tune(tune)
    assert tune.gains is not None
    gains = tune.gains
    if unit.settings.kind == "pid":
        unit.use(unit.settings.by_pid(gains))
    found = (("control", "pid"), ("pid_kp", gains.kp), ("pid_ki", gains.ki), ("pid_kd", gains.kd))
    return _report(unit, found)


async def calibrate_mpc(unit: Heater, target_c: float, fan_steps: int) -> Done:
    """Find the model of a heater by heating it to TARGET_C; raises CanductorError."""
    heater_w, fan = unit.settings.heater_w, unit.fan
    assert heater_w is not None
    tune = MpcTune(target_c, heater_w, unit.settings.max_power, fan_steps if fan is not None else 0)

    def blow() -> None:
        if fan is not None:
            fan.unit.set_speed(tune.fan_speed)

    before = 0.0 if fan is None else fan.unit.speed
    try:
        await unit.tune(tune, blow)
    finally:
        if fan is not None:
            fan.unit.set_speed(before)
    assert tune.model is not None
    model = tune.model
    if unit.settings.kind == "mpc":
        unit.use(unit.settings.by_model(model))
    found: tuple[tuple[str, str | float], ...] = (
        ("control", "mpc"),
        ("heater_power", heater_w),
        ("block_heat_capacity", model.capacity_j_per_k),
        ("ambient_transfer", model.transfer_w_per_k),
        ("sensor_responsiveness", model.responsiveness_per_s),
    )
    if model.fan_transfer_w_per_k:
        transfers = ", ".join(f"{value:.6g}" for value in model.fan_transfer_w_per_k)
        found = (*found, ("fan_ambient_transfer", transfers))
    return _report(unit, found)


def _report(unit: Heater, found: tuple[tuple[str, str | float], ...]) -> Done:
    texts = {name: value if isinstance(value, str) else f"{value:.6g}" for name, value in found}
    unit.keep(texts)
    lines = (f"{name}: {text}" for name, text in texts.items())
    return Done((f"[{unit.name}] was calibrated, {REMARK}:", *lines))

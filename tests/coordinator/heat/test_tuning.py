"""Tuning: what is found about a heater, and how well it is then controlled."""

import random

import pytest

from coordinator.heat.mpc import Mpc
from coordinator.heat.mpc_tune import MpcTune
from coordinator.heat.pid import Pid, PidGains
from coordinator.heat.pid_tune import RelayTune, TuneError
from coordinator.heat.rise import Rise, fit_rise
from tests.coordinator.heat.plant import INTERVAL_S, Plant, bed, drive


def tune_pid(plant: Plant, target_c: float) -> PidGains:
    tune = RelayTune(target_c)
    while tune.gains is None:
        plant.run(tune.power(plant.now_s, plant.measure()), INTERVAL_S)
    assert tune.power(plant.now_s, plant.measure()) == 0
    return tune.gains


@pytest.mark.parametrize("seed", range(3))
def test_a_hot_end_tuned_by_its_swing_is_held(seed: int) -> None:
    gains = tune_pid(Plant(seed=seed), 200)
    controller = Pid(gains)
    seen = drive(Plant(seed=seed + 10), lambda now, c: controller.power(now, c, 200), 240)
    assert max(c for _, c in seen) < 204
    assert all(abs(c - 200) < 0.5 for _, c in seen[-200:])


def test_a_bed_tuned_by_its_swing_is_held() -> None:
    controller = Pid(tune_pid(bed(), 60))
    seen = drive(bed(), lambda now, c: controller.power(now, c, 60), 900)
    assert max(c for _, c in seen) < 63
    assert all(abs(c - 60) < 0.5 for _, c in seen[-1000:])


def test_the_constants_are_ziegler_and_nichols() -> None:
    """A triangle of 4 K and 20 s around the target: Ku = 4 · 0.5 / (π · 2), Tu = 20 s."""
    tune = RelayTune(100.0)
    now_s = 0.0
    while tune.gains is None:
        phase = (now_s % 20) / 20
        tune.power(now_s, 100 + 2 * (4 * abs(phase - 0.5) - 1))
        now_s += 0.1
    kp = 0.6 * 4 * 0.5 / (3.14159265 * 2) * 255
    assert tune.gains.kp == pytest.approx(kp, rel=0.02)
    assert tune.gains.ki == pytest.approx(kp / 10, rel=0.02)
    assert tune.gains.kd == pytest.approx(kp * 2.5, rel=0.02)


def test_a_heater_that_does_not_swing_is_told() -> None:
    with pytest.raises(TuneError, match="does not swing around 200 °C"):
        tune_pid(Plant(power_w=5), 200)


def tune_mpc(plant: Plant, target_c: float, fan_steps: int = 0, max_power: float = 1.0) -> MpcTune:
    tune = MpcTune(target_c, plant.power_w, max_power, fan_steps)
    while tune.model is None:
        plant.run(tune.power(plant.now_s, plant.measure()), INTERVAL_S)
        plant.fan = tune.fan_speed
    assert tune.power(plant.now_s, plant.measure()) == 0
    return tune


@pytest.mark.parametrize("seed", range(2))
def test_mpc_finds_what_the_heater_is(seed: int) -> None:
    plant = Plant(seed=seed, fan_loss=0.05)
    tune = tune_mpc(plant, 200, fan_steps=3)
    model = tune.model
    assert model is not None
    assert tune.ambient_c == pytest.approx(22, abs=0.2)
    assert model.capacity_j_per_k == pytest.approx(14, rel=0.02)
    assert model.transfer_w_per_k == pytest.approx(0.09, rel=0.02)
    assert model.fan_transfer_w_per_k == pytest.approx((0.09, 0.115, 0.14), rel=0.03)
    # Lag and transport delay together: 3.8 s.
    assert 1 / model.responsiveness_per_s == pytest.approx(3.8, rel=0.1)


def test_a_heater_calibrated_for_mpc_is_held() -> None:
    plants = [(Plant(), 220.0, 0.8, 240), (bed(), 70.0, 1.0, 600)]
    for plant, target, max_power, seconds in plants:
        model = tune_mpc(plant, target, max_power=max_power).model
        assert model is not None
        controller = Mpc(model, max_power=max_power)
        drive(plant, lambda now, c: 0.0, 1200)
        power = lambda now, c: controller.power(now, c, target)  # noqa: B023, E731
        seen = drive(plant, power, seconds)
        assert max(c for _, c in seen) < target + 0.5
        assert all(abs(c - target) < 0.3 for _, c in seen[-200:])


def test_calibration_waits_for_a_hot_heater_to_cool() -> None:
    plant = Plant()
    plant.block_c = plant.sensor_c = 150
    tune = tune_mpc(plant, 200)
    assert tune.ambient_c < 30
    assert tune.model is not None
    assert tune.model.transfer_w_per_k == pytest.approx(0.09, rel=0.05)


def test_calibration_fails_in_a_sentence() -> None:
    with pytest.raises(TuneError, match="too near"):
        tune_mpc(Plant(), 35)
    with pytest.raises(TuneError, match="phase 'heat' did not end"):
        tune_mpc(Plant(power_w=5), 200)


@pytest.mark.parametrize(("capacity", "k", "loss"), [(14, 0.3, 0.09), (700, 0.08, 1.2), (5, 1.5, 0.05)])
def test_the_fit_recovers_a_simulated_rise(capacity: float, k: float, loss: float) -> None:
    """Euler steps of 1 ms are the oracle of the closed form."""
    heat_w, ambient, noise = capacity * 2.5, 20.0, random.Random(3)
    rise, block, sensor = Rise(), ambient, ambient
    for step in range(90_000):
        if step % 300 == 0:
            rise.add(50 + step / 1000, sensor + noise.gauss(0, 0.02))
        block += (heat_w - loss * (block - ambient)) / capacity / 1000
        sensor += k * (block - sensor) / 1000
    found = fit_rise(rise, heat_w, ambient, transfer_w_per_k=loss)
    assert found.capacity_j_per_k == pytest.approx(capacity, rel=0.01)
    assert found.responsiveness_per_s == pytest.approx(k, rel=0.02)
    assert found.loss_per_s == loss / found.capacity_j_per_k
    guessed = fit_rise(rise, heat_w, ambient)
    assert guessed.capacity_j_per_k == pytest.approx(capacity, rel=0.02)
    assert guessed.responsiveness_per_s == pytest.approx(k, rel=0.05)
    assert guessed.loss_per_s == pytest.approx(loss / capacity, rel=0.1)


def test_a_long_rise_stays_bounded() -> None:
    rise = Rise()
    for k in range(100_000):
        rise.add(k * 0.3, 20 + k * 0.001)
    assert 900 < len(rise.points) <= 2001
    assert rise.points[0] == (0.0, 20.0)
    steps = {round(b[0] - a[0], 6) for a, b in zip(rise.points, rise.points[1:], strict=False)}
    assert len(steps) == 1


def test_too_short_a_rise_is_told() -> None:
    rise = Rise()
    rise.add(0, 20)
    with pytest.raises(TuneError, match="too fast"):
        fit_rise(rise, 40, 20)

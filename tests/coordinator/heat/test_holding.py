"""The band that a heater keeps: when steady state begins and ends, and what PID, MPC and switching keep."""

from collections.abc import Callable

import pytest

from coordinator.heat.controller import NEAR_K, Controller
from coordinator.heat.holding import SETTLING_S, Held, Holding
from coordinator.heat.mpc import HeaterModel, Mpc
from coordinator.heat.pid import Pid, PidGains
from coordinator.heat.watermark import Watermark
from tests.coordinator.heat.plant import Plant, bed, drive


def feed(holding: Holding, *celsius: float, begin_s: float = 0.0, target_c: float = 60.0) -> Held | None:
    """Feed a measurement a second, all settled; return the last steady state that ended."""
    ended = None
    for index, value in enumerate(celsius):
        ended = holding.measured(begin_s + index, value, target_c, 0.5, settled=True) or ended
    return ended


def test_steady_state_begins_some_time_after_the_target_is_reached() -> None:
    holding = Holding(settling_s=3)
    assert holding.measured(10.0, 20.0, 60.0, 1.0, settled=False) is None
    feed(holding, 63.0, 62.0, 58.0, begin_s=20)
    assert holding.held is None
    feed(holding, 60.5, 59.8, begin_s=23)
    held = holding.held
    assert held is not None
    assert (held.since_s, held.until_s, held.low_c, held.high_c) == (23, 24, 59.8, 60.5)
    assert (held.measurements, held.seconds) == (2, 1)
    assert held.deviation_k == pytest.approx(0.5)


def test_what_happens_once_it_is_steady_counts_even_if_it_is_not_settled_any_more() -> None:
    holding = Holding(settling_s=0)
    feed(holding, 60.0)
    holding.measured(1.0, 55.0, 60.0, 1.0, settled=False)
    assert holding.held is not None
    assert holding.held.deviation_k == 5


def test_a_new_target_ends_it_and_the_same_target_again_does_not() -> None:
    holding = Holding(settling_s=1)
    assert feed(holding, 60.0, 60.0, 61.0) is None
    assert feed(holding, 62.0, begin_s=3) is None
    ended = feed(holding, 62.0, begin_s=4, target_c=70.0)
    assert ended is not None
    assert (ended.target_c, ended.since_s, ended.until_s, ended.high_c) == (60, 1, 3, 62)
    assert holding.held is None
    assert feed(holding, 70.0, begin_s=5, target_c=70.0) is None
    assert holding.held is not None
    off = feed(holding, 70.0, begin_s=6, target_c=0.0)
    assert off is not None
    assert off.target_c == 70
    feed(holding, *[20.0] * 20, begin_s=7, target_c=0.0)
    assert holding.held is None
    assert holding.end() is None


def test_the_mean_is_of_whole_cycles() -> None:
    holding = Holding(settling_s=0)
    values = [(58, 0.0), (58, 1.0), (60, 1.0), (62, 0.0), (60, 0.0), (58, 1.0), (60, 1.0), (99, 0.0)]
    for second, (celsius, power) in enumerate(values):
        holding.measured(second, celsius, 60.0, power, settled=True)
    held = holding.held
    assert held is not None
    assert held.cycles == 1
    assert held.mean_c == (58 + 60 + 62 + 60) / 4


# ------------------------------------------------------------------------------------- what is kept


def kept(plant: Plant, controller: Controller, target_c: float, seconds: float) -> Held:
    holding = Holding()

    def power(now_s: float, measured_c: float) -> float:
        wanted = controller.power(now_s, measured_c, target_c)
        settled = controller.settled(measured_c, target_c)
        holding.measured(now_s, measured_c, target_c, wanted, settled=settled)
        return wanted

    drive(plant, power, seconds)
    held = holding.end()
    assert held is not None, "it was never steady"
    assert held.seconds > seconds / 4
    return held


def model(plant: Plant) -> Mpc:
    return Mpc(
        HeaterModel(
            power_w=plant.power_w,
            capacity_j_per_k=plant.capacity,
            transfer_w_per_k=plant.loss,
            responsiveness_per_s=1 / plant.sensor_tau_s,
        ),
        reach_s=6.0,
    )


@pytest.mark.parametrize(
    ("plant", "controller", "target_c"),
    [
        (Plant(), lambda _: Pid(PidGains(22.2, 1.08, 114)), 220.0),
        (bed(), lambda _: Pid(PidGains(120, 0.7, 1500)), 60.0),
        (Plant(), model, 220.0),
        (bed(), model, 60.0),
    ],
    ids=["pid-hotend", "pid-bed", "mpc-hotend", "mpc-bed"],
)
def test_pid_and_mpc_stay_near_the_target(
    plant: Plant, controller: Callable[[Plant], Controller], target_c: float
) -> None:
    assert kept(plant, controller(plant), target_c, 600.0).deviation_k <= NEAR_K


def quick_bed() -> Plant:
    """Return a bed whose sensor is near to the heater."""
    return Plant(power_w=250, capacity=450, loss=1.6, sensor_tau_s=2, delay_s=0.0, noise_k=0.0)


@pytest.mark.parametrize("max_delta_k", [0.5, 2.0, 4.0])
def test_switching_swings_by_its_own_option_and_keeps_the_mean(max_delta_k: float) -> None:
    """It has to: heat goes on until max_delta above the target, and is off until as much below.

    What it overshoots by is what follows after the switching, at the rates of this bed: up to 0.45 K/s up and
    0.13 K/s down, for the sensor's 2 s and the 0.3 s to the next measurement.
    """
    held = kept(quick_bed(), Watermark(max_delta_k=max_delta_k), 60.0, 900.0)
    assert max_delta_k <= held.high_c - 60 <= max_delta_k + 0.45 * 2.3
    assert max_delta_k <= 60 - held.low_c <= max_delta_k + 0.13 * 2.3
    assert held.cycles >= 3
    assert held.mean_c == pytest.approx(60, abs=NEAR_K)


def test_the_same_bed_is_within_one_kelvin_with_pid() -> None:
    assert kept(quick_bed(), Pid(PidGains(60, 1.5, 300)), 60.0, 900.0).deviation_k <= NEAR_K


def test_the_settling_time_is_what_the_documentation_says() -> None:
    assert SETTLING_S == 10

"""Filament cools the hot end: what is known of it before it passes keeps the temperature."""

from collections.abc import Callable

import pytest

from coordinator.heat.mpc import HeaterModel, Mpc, filament_heat
from coordinator.heat.pid import Pid, PidGains
from coordinator.modules.heaters.heater import COMING_S
from tests.coordinator.heat.plant import INTERVAL_S, Plant

TARGET_C = 220.0
FILAMENT = filament_heat(1.75, 1.2, 1.8)
ACTS_S = 0.4
"""A power is sent so far ahead of its time."""


def flow(now_s: float) -> float:
    """Return mm/s: off and on again, as between a travel and fast infill."""
    return 6.0 if 300 <= now_s < 330 or now_s >= 345 else 0.0


def mean_flow(begin_s: float, end_s: float) -> float:
    return sum(flow(begin_s + (end_s - begin_s) * (n + 0.5) / 20) for n in range(20)) / 20


def worst(power: Callable[[Plant, float], float]) -> float:
    """Return how far the block gets from its target by what passes, K."""
    plant = Plant(sensor_tau_s=1.0, delay_s=ACTS_S + 0.2, noise_k=0.03, filament_j_per_mm_k=FILAMENT)
    off = 0.0
    for _ in range(round(290 / INTERVAL_S)):
        measured = plant.measure()
        wanted = power(plant, measured)
        for _ in range(round(INTERVAL_S / 0.03)):
            plant.filament_mm_per_s = flow(plant.now_s)
            plant.run(wanted, 0.03)
        if plant.now_s > 295:
            off = max(off, abs(plant.block_c - TARGET_C))
    return off


def mpc(tell: Callable[[Mpc, float], None]) -> Callable[[Plant, float], float]:
    model = HeaterModel(
        power_w=40.0,
        capacity_j_per_k=14.0,
        transfer_w_per_k=0.09,
        responsiveness_per_s=1.0,
        filament_j_per_mm_k=FILAMENT,
    )
    controller = Mpc(model, reach_s=2.0)

    def power(plant: Plant, measured_c: float) -> float:
        tell(controller, plant.now_s)
        return controller.power(plant.now_s, measured_c, TARGET_C)

    return power


def ahead(controller: Mpc, now_s: float) -> None:
    acts_s = now_s + ACTS_S
    controller.set_filament(mean_flow(now_s - INTERVAL_S, now_s), mean_flow(acts_s, acts_s + COMING_S))


def test_what_is_known_ahead_keeps_the_hot_end_nearer_to_its_target() -> None:
    blind = worst(mpc(lambda *_: None))
    late = worst(mpc(lambda controller, now_s: controller.set_filament(flow(now_s))))
    known = worst(mpc(ahead))
    gains = Pid(PidGains(22.2, 1.08, 114))
    pid = worst(lambda plant, measured_c: gains.power(plant.now_s, measured_c, TARGET_C))
    assert flow(310) * FILAMENT * (TARGET_C - 22) == pytest.approx(6.2, abs=0.1), "W; a heater of 40 W"
    # In K, as it was measured: PID 1.21, MPC 0.89 without knowing, 0.33 told as it happens, 0.16 told before.
    assert known < 0.25 * blind
    assert known < 0.6 * late
    assert known < 0.25 * pid


def test_what_is_pulled_back_takes_no_heat() -> None:
    controller = Mpc(
        HeaterModel(power_w=40, capacity_j_per_k=14, transfer_w_per_k=0.09, responsiveness_per_s=1)
    )
    controller.set_filament(-30.0, -5.0)
    assert controller.filament_mm_per_s == 0

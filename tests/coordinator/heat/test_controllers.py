"""Controllers on a heater that shares no code with them."""

from collections.abc import Callable

import pytest

from coordinator.heat.controller import Controller
from coordinator.heat.mpc import HeaterModel, Mpc, filament_heat
from coordinator.heat.pid import Pid, PidGains
from coordinator.heat.watermark import Watermark
from tests.coordinator.heat.plant import INTERVAL_S, Plant, bed, drive

USUAL = PidGains(22.2, 1.08, 114)


def model_of(
    plant: Plant, power_part: float = 1.0, *, fans: tuple[float, ...] = (), filament: float = 0.0
) -> HeaterModel:
    """Return the model that MPC_CALIBRATE would find, its heater's power wrong by POWER_PART."""
    return HeaterModel(
        power_w=plant.power_w * power_part,
        capacity_j_per_k=plant.capacity,
        transfer_w_per_k=plant.loss,
        responsiveness_per_s=1 / (plant.sensor_tau_s + plant.delay_s),
        fan_transfer_w_per_k=fans,
        filament_j_per_mm_k=filament,
    )


def heat(plant: Plant, controller: Controller, target_c: float, seconds: float) -> list[float]:
    power = lambda now, measured: controller.power(now, measured, target_c)  # noqa: E731
    return [celsius for _, celsius in drive(plant, power, seconds)]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("control", ["pid", "mpc", "mpc -10 %", "mpc +10 %"])
def test_a_hot_end_is_held_within_a_fifth_of_a_kelvin(control: str, seed: int) -> None:
    plant = Plant(seed=seed)
    parts = {"mpc": 1.0, "mpc -10 %": 0.9, "mpc +10 %": 1.1}
    controller: Controller = Pid(USUAL) if control == "pid" else Mpc(model_of(plant, parts[control]))
    seen = heat(plant, controller, 200, 300)
    assert max(seen) < (203 if control == "pid" else 200.3)
    steady = seen[len(seen) * 2 // 3 :]
    assert 199.8 < min(steady) <= max(steady) < 200.2
    assert controller.settled(plant.sensor_c, 200)


@pytest.mark.parametrize("part", [0.9, 1.0])
def test_a_bed_is_held_by_mpc(part: float) -> None:
    plant = bed()
    seen = heat(plant, Mpc(model_of(plant, part)), 60, 900)
    assert max(seen) < 60.3
    assert min(seen[-1000:]) > 59.8


@pytest.mark.parametrize("max_power", [0.3, 1.0])
def test_the_integral_does_not_wind_up(max_power: float) -> None:
    """A heater that cannot reach its target for minutes leaves full power at once when it can."""
    plant = Plant(ambient_c=-60)
    controller = Pid(PidGains(22.2, 10.0, 114), max_power=max_power)
    heat(plant, controller, 300, 60)
    held = plant.sensor_c
    for _ in range(5):
        assert controller.power(plant.now_s, held, held - 20) < 0.5 * max_power
        plant.run(0, INTERVAL_S)


def test_pid_is_linear_within_its_limits() -> None:
    """Numbers worked out by hand: 255 stands for full power."""
    controller = Pid(PidGains(2.55, 0.255, 25.5), smooth_s=1.0)
    assert controller.power(10.0, 100.0, 120.0) == pytest.approx(0.2)
    # 1 s later: error 20 for 1 s gives 0.02; nothing changed.
    assert controller.power(11.0, 100.0, 120.0) == pytest.approx(0.22)
    # The measurement rises by 1 K/s, smoothed over 1 s: 0.1 less, error 19.
    assert controller.power(12.0, 101.0, 120.0) == pytest.approx(0.19 + 0.039 - 0.1)
    assert controller.power(13.0, 101.0, 0.0) == 0.0
    assert controller.power(14.0, 101.0, 121.0) == pytest.approx(0.2 + 0.02), "off forgets the integral"


def test_a_new_target_gives_no_kick() -> None:
    controller = Pid(PidGains(1.0, 0.0, 500.0))
    for k in range(10):
        controller.power(k * 0.3, 50.0, 60.0)
    assert controller.power(3.0, 50.0, 100.0) == pytest.approx(50 / 255)


@pytest.mark.parametrize("max_delta", [0.5, 2.0])
def test_watermark_swings_by_its_delta(max_delta: float) -> None:
    plant = bed()
    seen = heat(plant, Watermark(max_delta_k=max_delta, max_power=0.9), 60, 900)
    late = seen[len(seen) // 2 :]
    # The block goes on warming the sensor after the switch.
    assert 60 - max_delta - 3 < min(late) < 60 - max_delta + 0.2
    assert 60 + max_delta - 0.2 < max(late) < 60 + max_delta + 3


def test_watermark_switches_at_its_marks_only() -> None:
    controller = Watermark(max_power=0.7, max_delta_k=2)
    steps = [(50, 0.7), (57.9, 0.7), (61.9, 0.7), (62, 0), (58.1, 0), (58, 0.7), (60, 0.7)]
    assert [controller.power(0.0, c, 60) for c, _ in steps] == [power for _, power in steps]
    assert controller.power(0.0, 50, 0) == 0
    assert controller.settled(58, 60)
    assert not controller.settled(57.9, 60)


def test_watermark_at_its_edges() -> None:
    controller = Watermark()
    assert controller.power(0.0, 60.0, 60.0) == 0.0, "off until it is cold"
    for celsius, target_c, power in (
        (58.1, 60.0, 0.0),
        (58.0, 60.0, 1.0),
        (61.9, 60.0, 1.0),
        (62.0, 60.0, 0.0),
        (-50.0, 0.0, 0.0),
        (-50.0, 1.0, 1.0),
        (-50.0, 0.0, 0.0),
    ):
        assert controller.power(0.0, celsius, target_c) == power


# ------------------------------------------------------------------------------------------------------- MPC


def disturbed(controller: Mpc, plant: Plant, tell: Callable[[], None]) -> float:
    """Hold 200 °C, blow at the block with a fan; return how far the temperature falls."""
    heat(plant, controller, 200, 200)
    plant.fan = 1.0
    tell()
    return 200 - min(heat(plant, controller, 200, 60))


def test_mpc_that_knows_of_the_fan_holds_better_and_both_come_back() -> None:
    known, unknown = (Plant(fan_loss=0.06), Plant(fan_loss=0.06))
    controllers = [Mpc(model_of(plant, fans=(0.09, 0.15))) for plant in (known, unknown)]
    told = disturbed(controllers[0], known, lambda: controllers[0].set_fan(1.0))
    untold = disturbed(controllers[1], unknown, lambda: None)
    assert told < 0.5 < untold
    for plant, controller in zip((known, unknown), controllers, strict=True):
        assert abs(heat(plant, controller, 200, 60)[-1] - 200) < 0.2
    assert abs(controllers[0].unexplained_w) < 2
    assert controllers[1].unexplained_w == pytest.approx(-0.06 * 178, abs=1.5)


def test_mpc_heats_for_the_filament_it_is_told_of() -> None:
    heat_of_mm = filament_heat(1.75, 1.24, 1.8)
    assert heat_of_mm == pytest.approx(3.14159 * 0.875**2 * 1.24e-3 * 1.8, rel=1e-4)
    falls = []
    for told in (True, False):
        plant = Plant(noise_k=0.0)
        controller = Mpc(model_of(plant, filament=heat_of_mm))
        heat(plant, controller, 200, 200)
        controller.set_filament(5.0 if told else 0.0)
        plant.other_w = -5.0 * heat_of_mm * (200 - plant.ambient_c)
        falls.append(200 - min(heat(plant, controller, 200, 60)))
    assert falls[0] < 0.5
    assert falls[1] > 2 * falls[0]


def test_mpc_starts_hot_without_a_jump() -> None:
    plant = Plant()
    heat(plant, Mpc(model_of(plant)), 200, 200)
    again = heat(plant, Mpc(model_of(plant)), 200, 120)
    assert 197 < min(again) <= max(again) < 203


def test_mpc_stops_at_its_max_power_and_when_off() -> None:
    plant = Plant()
    controller = Mpc(model_of(plant), max_power=0.6)
    assert controller.power(1.0, 22.0, 250.0) == pytest.approx(0.6)
    assert controller.power(1.3, 22.0, 0.0) == 0.0
    assert controller.ambient_c == pytest.approx(22, abs=3)


def test_a_time_that_stands_still_changes_nothing() -> None:
    for controller in (Pid(USUAL), Mpc(model_of(Plant()))):
        first = [controller.power(5.0, 150.0, 200.0) for _ in range(3)]
        assert len(set(first)) == 1

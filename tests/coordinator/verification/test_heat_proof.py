"""The demo's statement about heat: it holds for what was held, and for nothing else."""

from dataclasses import replace

import pytest

from coordinator.heat.holding import Held
from coordinator.verification.heat_proof import HeatProof, not_steady, prove_heat
from nodes.virtual.plant_log import PlantEvent

S = 1_000_000_000
HELD = Held(
    target_c=220.0,
    since_s=10.0,
    until_s=40.0,
    low_c=219.6,
    high_c=220.5,
    measurements=100,
    cycles=0,
    mean_c=None,
)
STATE = HeatProof(
    heater="extruder",
    control="pid",
    max_delta_k=2.0,
    node="mcu",
    body="extruder",
    held=HELD,
    span_ns=(10 * S, 40 * S),
)


def body(at_s: float, celsius: float, name: str = "extruder") -> PlantEvent:
    return PlantEvent(round(at_s * S), "body", name, celsius)


LOG = [body(9.8, 230.0), body(10.0, 219.5), body(20.0, 220.4), body(40.0, 220.0), body(40.2, 190.0)]


def test_the_truth_is_that_of_its_time_and_body() -> None:
    log = [*LOG, body(20.0, 60.0, "heater_bed"), PlantEvent(20 * S, "power", "extruder", 40.0)]
    (proof,) = prove_heat([STATE, replace(STATE, node="toolhead")], "mcu", log)
    assert (proof.true_low_c, proof.true_high_c) == (219.5, 220.4)
    assert proof.deviation_k == pytest.approx(0.5)
    assert proof.holds
    assert "220 °C in steady state for 30 s" in proof.to_text()
    assert "0.50 K off at most (allowed: 1 K)" in proof.to_text()


@pytest.mark.parametrize("control", ["pid", "mpc"])
@pytest.mark.parametrize("celsius", [218.9, 221.1])
def test_one_measurement_outside_breaks_it(control: str, celsius: float) -> None:
    held = replace(HELD, low_c=min(celsius, 220.0), high_c=max(celsius, 220.0))
    (proof,) = prove_heat([replace(STATE, control=control, held=held)], "mcu", LOG)
    assert not proof.holds
    assert proof.to_json()["deviation_k"] == pytest.approx(1.1)


def test_the_truth_outside_breaks_it_though_the_sensor_tells_nothing() -> None:
    (proof,) = prove_heat([STATE], "mcu", [*LOG, body(30.0, 222.0)])
    assert not proof.holds


def test_where_nothing_is_known_of_the_truth_nothing_holds() -> None:
    (proof,) = prove_heat([STATE], "mcu", [])
    assert not proof.holds
    assert proof.to_json()["true_c"] is None


def test_what_is_switched_has_to_keep_its_mean() -> None:
    held = replace(HELD, target_c=60.0, low_c=57.7, high_c=63.0, cycles=2, mean_c=60.4)
    state = replace(STATE, control="watermark", held=held)
    (switched,) = prove_heat([state], "mcu", [body(10.0, 57.5), body(20.0, 63.2)])
    assert switched.holds
    assert "switched 2 K above and below, as its max_delta says; 60.40 °C on average of 2 cycles" in (
        switched.to_text()
    )
    assert not replace(switched, held=replace(held, mean_c=61.2)).holds
    assert not replace(switched, control="pid").holds
    assert "no whole cycle" in replace(switched, held=replace(held, cycles=0, mean_c=None)).to_text()


def test_it_says_which_heaters_were_never_steady() -> None:
    assert not_steady(["extruder"], [STATE]) is None
    sentence = not_steady(["heater_bed", "extruder"], [STATE])
    assert sentence is not None
    assert sentence.startswith("heater_bed: nothing to compare")

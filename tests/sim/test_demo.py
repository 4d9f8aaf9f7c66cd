"""The demo's proof in virtual time: it holds where all is well, and in bad conditions too."""

import pytest

from coordinator.simulate.scenario import BusSetting, NodeSetting
from coordinator.support.examples import EXAMPLES
from coordinator.support.toml_values import Range
from coordinator.verification.proof import EDGE_TOLERANCE_S
from tests.stages.demo_machine import SQUARE
from tests.stages.simulated_demo import SimulatedDemo

DEMO = EXAMPLES / "demo" / "machine.cfg"
CLOCK_FREQ_UART = 16_000_000
WAY = """\
G28
M83
G91
{first}
G1 X-20 Y4 E0.5
M400
G1 X6 Y18 E0.6
{second}
SET_VELOCITY_LIMIT ACCEL=1500
G1 X-9 Y-3 E0.3
G1 X3 Y2 Z1 E0.1
"""
FIELDS = (
    *("nodes", "moves", "steps", "queue_steps", "bytes_to_nodes", "position_error_steps"),
    *("worst_step_error_us", "clock_rms_us", "retransmitted_bytes", "min_lead_ms"),
)


@pytest.mark.parametrize("loss", [0.0, 0.05])
def test_the_proof_holds_with_wrong_clocks_a_rollover_and_lost_frames(loss: float) -> None:
    demo = SimulatedDemo(
        DEMO,
        seed=7,
        nodes={
            "mcu": NodeSetting(ppm=Range(-20, -20)),
            "toolhead": NodeSetting(ppm=Range(200, 200), clock_hz=64_000_000),
            "zboard": NodeSetting(
                ppm=Range(-110, -110), clock_hz=CLOCK_FREQ_UART, rollover_after_s=Range(5, 5)
            ),
        },
        buses={"can0": BusSetting(loss=Range(loss, loss))},
    )
    report = demo.prove(SQUARE)
    assert report.ok, report.to_text()
    told = report.to_json()
    assert set(FIELDS) <= set(told)
    assert told["nodes"] == ["mcu", "toolhead", "zboard"]
    assert told["position_error_steps"] == 0
    assert told["steps"] == told["steps_planned"]
    assert sum(stepper.steps_executed for stepper in report.steppers) > 30_000
    worst_band_s = max(stepper.worst_band_error_s for stepper in report.steppers)
    assert worst_band_s <= EDGE_TOLERANCE_S
    # Stated with the figure: beyond the band, a step errs by what its node's clock does.
    worst_s = max(stepper.worst_error_s for stepper in report.steppers)
    assert worst_s <= EDGE_TOLERANCE_S + max(clock.worst_s for clock in report.clocks) + 1e-6
    assert {clock.node for clock in report.clocks} == {"toolhead", "zboard"}
    assert all((node.link.min_lead_s or 0) > 0 for node in report.outcome.nodes)
    assert {place.axis for place in report.places} == set("xyz")
    assert max(abs(place.error_mm) for place in report.places) < 0.0125
    assert (report.frames_lost > 0) == (loss > 0)
    assert (sum(node.link.bytes_repeated for node in report.outcome.nodes) > 100) == (loss > 0)
    assert "PROVED" in report.to_text()


@pytest.mark.parametrize(
    ("machine", "first", "second"),
    [
        (
            "delta",
            "M104 S188\nM190 S52.5\nTEMPERATURE_WAIT SENSOR=extruder MINIMUM=180\nG1 X12 Y-15 Z-60 F6000",
            "G4 P50",
        ),
        ("corexy", "G1 X40 Y40 Z6 F6000", "SET_PRESSURE_ADVANCE ADVANCE=0.1"),
        (
            "corexy",
            "SET_INPUT_SHAPER SHAPER_TYPE=ei SHAPER_FREQ_X=45 SHAPER_FREQ_Y=0\nG1 X40 Y40 Z6 F6000",
            "SET_INPUT_SHAPER SHAPER_FREQ_Y=38\nSET_PRESSURE_ADVANCE ADVANCE=0.1 SMOOTH_TIME=0.02",
        ),
        (
            "extruders",
            "G1 X40 Y40 Z6 F6000",
            "T1\nG1 X3 E0.4\nSYNC_EXTRUDER_MOTION EXTRUDER=extruder MOTION_QUEUE=extruder1",
        ),
    ],
    ids=["delta", "pressure advance", "input shapers", "two extruders"],
)
def test_non_linear_shaped_smoothed_and_changing_steppers_are_proved(
    machine: str, first: str, second: str
) -> None:
    report = SimulatedDemo(EXAMPLES / f"{machine}.cfg").prove(WAY.format(first=first, second=second))
    assert report.ok, report.to_text()
    steps = sum(stepper.steps_executed for stepper in report.steppers)
    assert steps == sum(stepper.steps_expected for stepper in report.steppers)
    assert steps > 10_000
    assert max(stepper.worst_band_error_s for stepper in report.steppers) <= 12.5e-6 * 1.001


HOT = """\
M140 S52
M104 S188
G28
M190 S52
M83
G1 X30 Y20 Z2 F6000
M106 S64
G1 X60 E1 F1800
G1 Y40 E0.5
G4 P1500
M104 S0
M140 S0
G1 X20 F6000
"""


def test_a_printer_homes_heats_and_holds_its_bed() -> None:
    """It begins warm, and the bed is to stay as it is: ten seconds of settling are enough to wait for."""
    report = SimulatedDemo(EXAMPLES / "cartesian_uart.cfg").prove(HOT)
    assert report.ok, report.to_text()
    assert {place.axis for place in report.places} == set("xyz")
    bed = next(heat for heat in report.heat if heat.heater == "heater_bed")
    assert (bed.control, bed.held.target_c) == ("pid", 52)
    assert bed.deviation_k <= 1
    assert 51 <= bed.held.low_c <= bed.held.high_c <= 53
    assert 51 <= bed.true_low_c <= bed.true_high_c <= 53

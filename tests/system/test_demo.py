"""The demo's proof: it holds where all is well, in bad conditions too, and fails where anything is not."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.demo.expected import expected_steps
from coordinator.demo.proof import EDGE_TOLERANCE_S, PrimaryClock, StepperProof, prove_stepper
from coordinator.motion.trapezoid_array import TRAPEZOID
from coordinator.timebase import ClockMap, ClockPiece
from tests.stages.processes import SQUARE, canductor, write_gcode

CLOCK_FREQ_UART = 16_000_000
FIELDS = (
    *("ok", "nodes", "moves", "steps", "queue_steps", "bytes_to_nodes", "position_error_steps"),
    *("worst_step_error_us", "clock_rms_us", "retransmitted_bytes", "min_lead_ms"),
)


def prove(folder: Path, *words: str) -> dict[str, Any]:
    """Run the demo on the square and return its figures, having checked that its proof holds."""
    ended = canductor("demo", "--json", "--no-web", "--gcode", write_gcode(folder, SQUARE), *words)
    assert ended.status == 0, ended
    report = ended.json
    assert report["ok"] is True
    assert set(FIELDS) <= set(report)
    assert report["nodes"] == ["mcu", "toolhead", "zboard"]
    assert report["position_error_steps"] == 0
    assert report["steps"] == report["steps_planned"] > 30_000
    assert report["worst_band_error_us"] <= EDGE_TOLERANCE_S * 1e6
    # Stated with the figure: beyond the band, a step errs by what its node's clock does.
    assert (
        report["worst_step_error_us"] <= EDGE_TOLERANCE_S * 1e6 + max(report["clock_worst_us"].values()) + 1
    )
    assert set(report["clock_rms_us"]) == {"toolhead", "zboard"}
    assert report["min_lead_ms"] > 0
    assert set(report["place_error_um"]) == set("xyz")
    assert max(map(abs, report["place_error_um"].values())) < 12.5
    return report


def test_the_proof_holds(tmp_path: Path) -> None:
    assert prove(tmp_path)["frames_lost"] == 0


@pytest.mark.parametrize("loss", ["0.01", "5%"])
def test_the_proof_holds_with_wrong_clocks_a_rollover_and_lost_frames(tmp_path: Path, loss: str) -> None:
    report = prove(
        tmp_path,
        *("--loss", loss, "--seed", "7", "--rate-ppm", "toolhead=200"),
        *("--start-clock", f"zboard={2**32 - CLOCK_FREQ_UART}"),
    )
    assert report["frames_lost"] > 0
    assert report["retransmitted_bytes"] > 0


CONFIG = Path(__file__).resolve().parents[2] / "config"
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
)
def test_non_linear_shaped_smoothed_and_changing_steppers_are_proved(
    tmp_path: Path, machine: str, first: str, second: str
) -> None:
    ended = canductor(
        *("demo", "--json", "--no-web", "--machine", str(CONFIG / f"{machine}.cfg")),
        *("--gcode", write_gcode(tmp_path, WAY.format(first=first, second=second))),
    )
    assert ended.status == 0, ended
    assert ended.json["ok"] is True
    assert ended.json["steps"] == ended.json["steps_planned"] > 10_000
    assert ended.json["worst_band_error_us"] <= 12.5 * 1.001


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


def test_a_printer_homes_heats_and_holds_its_bed(tmp_path: Path) -> None:
    """It begins warm, and the bed is to stay as it is: ten seconds of settling are enough to wait for."""
    ended = canductor(
        *("demo", "--json", "--no-web", "--machine", str(CONFIG / "cartesian_uart.cfg")),
        *("--gcode", write_gcode(tmp_path, HOT)),
    )
    assert ended.status == 0, ended
    report = ended.json
    assert report["ok"] is True
    assert set(report["place_error_um"]) == set("xyz")
    assert report["steps"] == report["steps_planned"] > 10_000
    heat = {state["heater"]: state for state in report["heat"]}
    bed = heat["heater_bed"]
    assert (bed["control"], bed["target_c"]) == ("pid", 52)
    assert bed["deviation_k"] <= 1
    for low, high in (bed["measured_c"], bed["true_c"]):
        assert 51 <= low <= high <= 53


# ---------------------------------------------------------------------------------------------- it can fail

FREQ = 1e6
STEP_MM = 0.01


class Exact:
    """A node whose clock is the host's, in µs."""

    def ticks_to_monotonic_ns(self, clock: np.ndarray) -> np.ndarray:
        return clock.astype(np.int64) * 1000


def there_and_back() -> np.ndarray:
    """Return two trapezoids: 2 mm along X in 0.3 s, and back."""
    moves = np.zeros(2, TRAPEZOID)
    for move, begin, start, way in zip(moves, (1.0, 1.3), (0.0, 2.0), (1.0, -1.0), strict=True):
        move["print_time"], move["start"][0], move["ratio"][0] = begin, start, way
        move["accel_s"] = move["cruise_s"] = move["decel_s"] = 0.1
        move["cruise_v"], move["accel"] = 10.0, 100.0
    return moves


def proof_of(clock: Any, direction: Any, *, counted: int = 0) -> StepperProof:
    return prove_stepper(
        "stepper_x",
        "mcu",
        expected_steps(there_and_back(), (1, 0, 0, 0), STEP_MM, 0.0),
        [(clock, direction)],
        counted=counted,
        clock_map=ClockMap(FREQ, ClockPiece(0.0, 0.0, FREQ)),
        truth=Exact(),
        primary=PrimaryClock(monotonic_ns=0, ticks=0, true_ticks_per_s=FREQ, clock_freq=FREQ),
    )


@pytest.fixture(name="executed")
def _executed() -> tuple[Any, Any]:
    """What a node does that is right to the tick."""
    (steps,) = expected_steps(there_and_back(), (1, 0, 0, 0), STEP_MM, 0.0)
    return np.round(steps.print_time * FREQ).astype(np.uint64), steps.direction


def test_what_is_right_is_proved(executed: tuple[Any, Any]) -> None:
    proof = proof_of(*executed)
    assert proof.holds
    assert proof.steps_executed == 400
    assert proof.worst_band_error_s < 1e-6


def test_a_lost_step_is_found(executed: tuple[Any, Any]) -> None:
    clock, direction = executed
    for lost in range(len(clock)):
        proof = proof_of(np.delete(clock, lost), np.delete(direction, lost))
        assert not proof.holds
        assert (proof.steps_executed, proof.position_error_steps) == (399, 1)


def test_two_lost_steps_that_cancel_out_are_found(executed: tuple[Any, Any]) -> None:
    clock, direction = executed
    proof = proof_of(np.delete(clock, [3, 396]), np.delete(direction, [3, 396]))
    assert proof.position_error_steps == 0
    assert not proof.holds


@pytest.mark.parametrize("shift_us", [-100, 26, 100])
def test_a_step_at_another_time_is_found(executed: tuple[Any, Any], shift_us: int) -> None:
    clock, direction = executed
    for shifted in range(0, len(clock), 7):
        late = clock.copy()
        late[shifted] = int(late[shifted]) + shift_us
        proof = proof_of(late, direction)
        assert not proof.holds
        assert proof.worst_band_error_s == pytest.approx(abs(shift_us) * 1e-6, abs=1e-6)
        assert proof.worst_error_s == pytest.approx(abs(shift_us) * 1e-6, abs=1e-6)


def test_a_reversed_step_is_found(executed: tuple[Any, Any]) -> None:
    clock, direction = executed
    wrong = direction.copy()
    wrong[17] *= -1
    proof = proof_of(clock, wrong)
    assert not proof.holds
    assert (proof.wrong_directions, proof.position_error_steps) == (1, 2)


def test_two_steps_in_exchanged_directions_are_found(executed: tuple[Any, Any]) -> None:
    clock, direction = executed
    wrong = direction.copy()
    wrong[[10, 390]] = wrong[[390, 10]]
    proof = proof_of(clock, wrong)
    assert proof.position_error_steps == 0
    assert proof.wrong_directions == 2
    assert not proof.holds


def test_a_step_too_many_is_found(executed: tuple[Any, Any]) -> None:
    clock, direction = executed
    proof = proof_of(np.append(clock, clock[-1] + 50), np.append(direction, direction[-1:]))
    assert not proof.holds
    assert proof.steps_executed == 401


def test_a_node_that_counts_otherwise_is_found(executed: tuple[Any, Any]) -> None:
    assert not proof_of(*executed, counted=1).holds


def test_no_step_at_all_is_found() -> None:
    assert not proof_of(np.empty(0, np.uint64), np.empty(0, np.int8)).holds

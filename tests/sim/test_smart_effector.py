"""[smart_effector] on a virtual bed; what its control pin says is decoded here again, bit by bit."""

from pathlib import Path

import numpy as np
import pytest

from tests.stages.probe_stage import MICROSTEP_MM, ProbeStage, heights, machine_text


def programs(stage: ProbeStage) -> list[int]:
    """Return the bytes that the control pin was sent, at 1000 bits per second."""
    edges = stage.edges("PB0", "toolhead")
    found: list[int] = []
    begin = 0.0
    for at, level in edges:
        if level and at > begin + 0.013:  # the 1 of 0 0 1 0
            begin = at
            bits = [_level(edges, at + (number + 0.5) * 1e-3) for number in range(12)]
            assert bits[:2] == [1, 0]
            assert bits[6] != bits[5]
            assert bits[11] != bits[10]
            found.append(int("".join(map(str, bits[2:6] + bits[7:11])), 2))
    return found


def _level(edges: list[tuple[float, int]], at: float) -> int:
    return [0, *(level for time, level in edges if time <= at)][-1]


def waits(stage: ProbeStage) -> list[float]:
    """Return how long Z stood before each way down, s."""
    at, ups = stage.steps("PB6", "PB7", "mcu")
    turns = np.flatnonzero(ups[:-1] & ~ups[1:])
    return list(at[turns + 1] - at[turns])


def accel_down(stage: ProbeStage) -> float:
    """Return the acceleration at the begin of the last way down, mm/s²."""
    at, ups = stage.steps("PB6", "PB7", "mcu")
    begin = np.flatnonzero(ups)[-1] + 1
    # Steps are due in the middle of their way: n + 1/2 of it after sqrt(2 (n + 1/2) / a).
    first, later = at[begin], at[begin + 30]
    way = MICROSTEP_MM * np.array([0.5, 30.5])
    return float(2 * ((np.sqrt(way[1]) - np.sqrt(way[0])) / (later - first)) ** 2)


def test_it_waits_before_the_way_down_and_limits_its_acceleration(tmp_path: Path) -> None:
    text = machine_text(
        kind="smart_effector", z={"homing_retract_dist": 0}, speed=15, recovery_time=0.8, probe_accel=100
    )
    stage = ProbeStage(tmp_path, text)
    lines = ("G28", "G1 Z6 F900", "M400", "PROBE", "SET_SMART_EFFECTOR ACCEL=40 RECOVERY_TIME=0.2")
    output = stage.do(*lines, on_ready=lambda _: None)
    assert len(heights(output)) == 1
    assert output[-2:] == ["probe_accel: 40 mm/s²", "recovery_time: 0.2 s"]
    first = waits(stage)[-1]
    assert accel_down(stage) == pytest.approx(100, rel=0.1)
    stage = ProbeStage(tmp_path, text)
    stage.do(*lines[:1], lines[-1], *lines[1:4])
    assert accel_down(stage) == pytest.approx(40, rel=0.1)
    assert first - waits(stage)[-1] == pytest.approx(0.6, abs=0.15)


def test_its_sensitivity_is_programmed(tmp_path: Path) -> None:
    stage = ProbeStage(tmp_path, machine_text(kind="smart_effector", control_pin="toolhead:PB0"))
    output = stage.do("SET_SMART_EFFECTOR SENSITIVITY=15", "RESET_SMART_EFFECTOR")
    assert programs(stage) == [105, 15, 240, 131, 131]
    assert output == [
        "the effector was sent sensitivity 15",
        "the effector was sent to use its own sensitivity",
    ]


@pytest.mark.parametrize("line", ["SET_SMART_EFFECTOR SENSITIVITY=20", "RESET_SMART_EFFECTOR"])
def test_without_a_control_pin_it_is_not_programmed(tmp_path: Path, line: str) -> None:
    stage = ProbeStage(tmp_path, machine_text(kind="smart_effector"))
    name = line.split(maxsplit=1)[0]
    with pytest.raises(
        Exception, match=rf"{name} needs control_pin of \[smart_effector\], which is not given"
    ):
        stage.do(line)

"""A probe that fails: every failure ends in a stop with its sentence, and says which Z was reached.

How deep the nozzle went is judged by the plant: its height above the bed, by the steps that the motors made.
"""

import re
from pathlib import Path

import pytest

from coordinator.virtual_machine.plant_bed import BedSettings
from nodes.virtual.plant_page import PlantFault
from tests.stages.probe_stage import START, ProbeStage, machine_text

LOWEST = -3.0
"""position_min of Z."""


def failure(stage: ProbeStage, *lines: str) -> str:
    """Run LINES, which have to fail; return the sentence."""
    with pytest.raises(Exception) as error:  # noqa: PT011 (whatever it is, its sentence counts)
        stage.do(*lines)
    return str(error.value)


def reached(sentence: str) -> float:
    """Return which Z SENTENCE says was reached."""
    found = re.search(r"Z is (-?\d+\.\d+) mm", sentence)
    assert found is not None, sentence
    return float(found[1])


def test_a_probe_that_never_triggers_ends_at_the_lowest_place(tmp_path: Path) -> None:
    stage = ProbeStage(tmp_path)
    stage.fault_above(5.5, PlantFault.NEVER)
    said = failure(stage, "G28", "G1 Z6 F600", "PROBE")
    assert re.search(r"PROBE failed: the probe did not trigger within (8\.99|9\.00)\d mm", said)
    assert reached(said) == pytest.approx(LOWEST, abs=0.005)
    assert stage.true_mm("z") == pytest.approx(LOWEST, abs=0.01), "no lower than that"


def test_homing_with_a_probe_that_never_triggers_says_how_far_it_went(tmp_path: Path) -> None:
    stage = ProbeStage(tmp_path, machine_text(z={"position_max": 10}))
    stage.fault(PlantFault.NEVER)
    said = failure(stage, "G28")
    assert "Z was not homed: the probe did not trigger within 19.500 mm" in said
    assert "the head was lowered by 19.500 mm" in said


def test_the_second_approach_of_homing_is_short(tmp_path: Path) -> None:
    """It stops 0.5 mm below position_min, however far homing_retract_dist is."""
    stage = ProbeStage(tmp_path, machine_text(z={"position_min": 1, "homing_retract_dist": 4}))
    stage.fault_above(4.0, PlantFault.NEVER)
    said = failure(stage, "G28")
    assert "the probe did not trigger within 5.000 mm" in said
    assert stage.true_mm("z") == pytest.approx(0.5, abs=0.02)


def test_a_probe_that_is_triggered_before_the_move_is_not_lowered(tmp_path: Path) -> None:
    stage = ProbeStage(tmp_path)
    stage.fault_above(5.5, PlantFault.ALWAYS)
    said = failure(stage, "G28", "G1 Z6 F600", "PROBE")
    assert (
        "PROBE failed: the probe was triggered before the move: lift the head, or check the probe's" in said
    )
    assert reached(said) == pytest.approx(6.0, abs=0.005)
    assert stage.true_mm("z") == pytest.approx(6.0, abs=0.01)


def test_homing_lifts_a_probe_that_is_triggered_and_then_gives_up(tmp_path: Path) -> None:
    stage = ProbeStage(tmp_path)
    stage.fault(PlantFault.ALWAYS)
    said = failure(stage, "G28")
    assert "Z was not homed: the probe was triggered before the move" in said
    assert stage.true_mm("z") == pytest.approx(START[2] + 3.0, abs=0.01), "it was lifted once"


@pytest.mark.parametrize("node", ["toolhead", "mcu"])
def test_a_node_that_is_lost_stops_the_probe(tmp_path: Path, node: str) -> None:
    """Whichever it is: of the probe, or of the motors."""
    stage = ProbeStage(tmp_path)
    begun: list[float] = []

    def cut() -> None:
        begun.append(stage.true_mm("z"))
        stage.stage.cut(node)

    stage.when(
        lambda: stage.true_mm("z") > 19.9,
        lambda: stage.when(lambda: stage.true_mm("z") < 12, cut),
    )
    said = failure(stage, "G28", "G1 Z20 F1200", "PROBE PROBE_SPEED=4")
    notices = [text for text in stage.output if text.startswith("the machine stopped while")]
    assert node in said
    (notice,) = notices
    assert begun
    # A node that hears nothing stops after a quarter of a second: 1 mm.
    assert begun[0] - stage.true_mm("z") < 1.2
    assert stage.true_mm("z") - 1.2 < reached(notice) < stage.true_mm("z") + 0.01
    assert notice.endswith(" mm or higher")


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        (("PROBE",), "PROBE comes before Z is homed; home with G28 first"),
        (("PROBE_ACCURACY",), "PROBE_ACCURACY comes before Z is homed"),
        (("PROBE_CALIBRATE",), "PROBE_CALIBRATE comes before Z is homed"),
        (("G28 Z",), "G28 of Z comes before X is homed; home with G28 first"),
        (
            ("G28", "G1 X190 F6000", "G28 Z"),
            "G28 of Z is refused: the probe would be at X 210, which is not over the bed",
        ),
    ],
)
def test_nothing_is_probed_where_nobody_knows_the_place(
    tmp_path: Path, lines: tuple[str, ...], sentence: str
) -> None:
    stage = ProbeStage(tmp_path)
    assert sentence in failure(stage, *lines)


def test_a_probe_that_would_miss_the_bed_is_refused_before_anything_moves(tmp_path: Path) -> None:
    stage = ProbeStage(tmp_path, machine_text(x_offset=-25))
    said = failure(stage, "G28")
    assert (
        "the probe would be at X -25, which is not over the bed (0 to 200 mm); add [safe_z_home], or move"
        in said
    )
    assert stage.true_mm("z") == START[2]


def test_there_is_no_way_down_below_the_lowest_place(tmp_path: Path) -> None:
    stage = ProbeStage(tmp_path, bed=BedSettings(hysteresis_mm=0.0))
    stage.fault_above(5.0, PlantFault.NEVER)
    said = failure(stage, "G28", "G1 Z6 F600", "G1 Z-3", "PROBE")
    assert re.search(
        r"cannot be lowered: Z is -(3\.00|2\.99)\d, and position_min of Z is -3 mm; move up", said
    )

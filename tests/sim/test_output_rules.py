"""What the checker says of outputs that are no stepper's, and scenarios that name what is not there."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from coordinator.simulate import scenario
from coordinator.simulate.checker import Ending, OutputTruth, check_output
from coordinator.simulate.play import play
from coordinator.support.toml_values import ScenarioError

MS = 1_000_000
STOP = Ending(cause="a stop", stopped_ns=1000 * MS, stop_s=0.1)


def output(*changes_ms: int, stopped: int = 0, reachable: bool = True) -> OutputTruth:
    """Return an output that is switched on and off in turn at these times."""
    levels = [(k + 1) % 2 for k in range(len(changes_ms))]
    return OutputTruth(
        name="lamp",
        node="mcu",
        at_ns=np.array(changes_ms, np.int64) * MS,
        level=np.array(levels, np.uint8),
        stopped=stopped,
        reachable=reachable,
    )


@pytest.mark.parametrize(
    ("truth", "ok"),
    [
        (output(), True),
        (output(500, 1050), True),
        (output(500), False),
        (output(500, 1150), False),
        (output(500, 1050, 1500, 1501), False),
        (output(stopped=1), False),
        (output(500, stopped=1), True),
        (output(500, 1150, reachable=False), True),
    ],
)
def test_behind_a_stop_an_output_keeps_its_shutdown_value(truth: OutputTruth, ok: bool) -> None:
    found = check_output(truth, STOP)
    assert [violation.rule for violation in found] == [] if ok else ["output"]
    assert check_output(truth, Ending()) == [], "without a stop nothing is asked"


@pytest.mark.parametrize(
    ("changes_ms", "ok"), [((), True), ((100, 190), True), ((100,), False), ((100, 190, 250, 260), False)]
)
def test_a_heater_is_off_while_its_sensor_is_not_sound(changes_ms: tuple[int, ...], ok: bool) -> None:
    truth = replace(output(*changes_ms), cold_ns=[(200 * MS, 300 * MS)])
    assert [violation.rule for violation in check_output(truth, Ending())] == ([] if ok else ["heat"])


HEAD = 'about = "A test."\nmachine = "heated"\n'
SENSOR = '[[faults]]\nkind = "sensor"\nnode = "{}"\nat_s = 1\nfor_s = 0.5\n'


def test_a_broken_sensor_needs_a_plant_and_a_sensor(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(HEAD + SENSOR.format("toolhead"))
    with pytest.raises(ScenarioError, match="a fault of kind sensor needs plant = true"):
        scenario.find(str(path))
    path.write_text(HEAD + 'plant = true\n[outputs.x]\nnode = "mcu"\npin = "PZ9"\n')
    with pytest.raises(ScenarioError, match=r"\[outputs.x\]: node 'mcu' has no such pin"):
        play(replace(scenario.find(str(path)), program=scenario.Program(lines="G28\n")), 0)

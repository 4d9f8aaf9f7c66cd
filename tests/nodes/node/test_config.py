"""What a node is configured as, and the table of its states."""

from pathlib import Path

import pytest

from nodes.devices.stepper import Stepper
from nodes.dictionary.dictionary import Dictionary
from nodes.node.config import NodeConfig, NodeConfigError
from nodes.node.states import TRANSITIONS, NodeEvent, NodeState
from tests.nodes.machine import make_config, stepper_x
from tests.nodes.state_pages import node_page
from tests.nodes.twin_bus import TwinNode, source_of, without_commands

ROOT = Path(__file__).parents[3]


def small() -> Dictionary:
    return TwinNode().dictionary


def test_a_missing_command_names_the_feature_it_makes_impossible() -> None:
    dictionary = TwinNode(source=without_commands("queue_step", "reset_step_clock")).dictionary
    with pytest.raises(
        NodeConfigError,
        match=r"stepper_x cannot work on node mainboard: its firmware .* has no queue_step, reset_step_clock",
    ):
        make_config(stepper_x())(dictionary)


def test_a_pin_the_board_does_not_have_names_the_feature() -> None:
    stepper = Stepper("stepper_x", step_pin="PZ1", dir_pin="PA2")
    with pytest.raises(NodeConfigError, match=r"stepper_x on node mainboard: .*no pin 'PZ1'"):
        make_config(stepper)(small())


def test_too_many_objects_are_refused() -> None:
    config = NodeConfig("mainboard", small())
    for i in range(255):
        assert config.create_oid() == i
    with pytest.raises(NodeConfigError, match="more than 255 objects"):
        config.create_oid()


def test_the_crc_tells_configurations_apart() -> None:
    build = make_config(stepper_x())
    assert build(small()).crc == build(small()).crc
    assert build(small()).crc != make_config(stepper_x(invert_step=True))(small()).crc


@pytest.mark.parametrize(
    ("constants", "pulse_s", "expected"),
    [
        ({"STEPPER_BOTH_EDGE": 1}, 0.0, "invert_step=-1 step_pulse_ticks=0"),
        ({"STEPPER_STEP_BOTH_EDGE": 1}, 0.0, "invert_step=-1 step_pulse_ticks=0"),
        ({}, 2e-6, "invert_step=1 step_pulse_ticks=2"),
        ({"STEPPER_BOTH_EDGE": 1}, 1e-9, "invert_step=1 step_pulse_ticks=1"),
    ],
)
def test_pulses_or_both_edges(constants: dict[str, int], pulse_s: float, expected: str) -> None:
    dictionary = TwinNode(source=source_of(config={"CLOCK_FREQ": 1_000_000} | constants)).dictionary
    stepper = stepper_x(step_pulse_s=pulse_s, invert_step=True)
    config = make_config(stepper)(dictionary)
    assert config.config_commands[1].endswith(expected)
    assert stepper.steps_on_both_edges == ("-1" in expected)
    assert (stepper.queue_step_id, stepper.set_next_step_dir_id, stepper.reset_step_clock_id) == (
        -32,
        -33,
        96,
    )


def test_both_edges_need_firmware_that_can() -> None:
    dictionary = TwinNode(source=source_of(config={"CLOCK_FREQ": 1_000_000})).dictionary
    with pytest.raises(NodeConfigError, match="cannot step on both edges"):
        make_config(stepper_x(step_pulse_s=0.0))(dictionary)


def test_the_diagram_of_the_states_is_not_stale() -> None:
    assert (ROOT / "docs" / "node-states.md").read_text() == node_page()


def test_every_state_can_be_reached_closed_and_only_closed_is_final() -> None:
    reached = {NodeState.CONNECTING, *TRANSITIONS.values()}
    assert reached == set(NodeState)
    for state in NodeState:
        assert ((state, NodeEvent.CLOSE) in TRANSITIONS) == (state is not NodeState.CLOSED)

"""The policy of a node: what is read, and what is refused with file and line."""

from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.errors import ConfigError
from coordinator.config.model import NodePolicy
from tests.stages.printer_text import PRINTER_CFG, changed, write

LIGHT = "\n[mcu light]\ncanbus_uuid: 0102030405aa\npolicy: {}\n"


def test_a_node_is_fatal_unless_it_says_otherwise(tmp_path: Path) -> None:
    description = load_machine(write(tmp_path, PRINTER_CFG))
    assert {node.policy for node in description.nodes} == {NodePolicy.FATAL}


@pytest.mark.parametrize("policy", NodePolicy)
def test_a_node_without_steppers_can_have_any(tmp_path: Path, policy: NodePolicy) -> None:
    description = load_machine(write(tmp_path, PRINTER_CFG + LIGHT.format(policy.value)))
    assert {node.name: node.policy for node in description.nodes}["light"] is policy


def refused(folder: Path, text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_machine(write(folder, text))
    return str(caught.value).replace(str(folder) + "/", "")


@pytest.mark.parametrize("policy", ["pause", "optional"])
def test_a_node_with_steppers_must_be_fatal(tmp_path: Path, policy: str) -> None:
    text = changed("serial: /dev/ttyACM0", f"serial: /dev/ttyACM0\npolicy: {policy}")
    assert refused(tmp_path, text) == (
        f"printer.cfg:6: option 'policy' of [mcu toolhead] is '{policy}', but the node carries [extruder], "
        "whose position would be lost; make it 'fatal'"
    )


def test_the_primary_must_be_fatal(tmp_path: Path) -> None:
    text = changed("canbus_uuid: 11aa22bb33cc", "canbus_uuid: 11aa22bb33cc\npolicy: optional")
    assert refused(tmp_path, text) == (
        "printer.cfg:3: option 'policy' of [mcu] is 'optional', but the primary node's clock is the time "
        "of all others; make it 'fatal'"
    )


def test_a_word_that_is_no_policy_is_refused(tmp_path: Path) -> None:
    assert refused(tmp_path, PRINTER_CFG + LIGHT.format("maybe")).endswith(
        "option 'policy' of [mcu light] is 'maybe', must be fatal, pause or optional"
    )

"""A virtual machine whose configuration is read again after it was started."""

from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.model import MachineDescription
from coordinator.virtual_machine.virtual_machine import VirtualMachine, VirtualMachineOptions
from nodes.support.errors import CanductorError
from tests.stages.printer_text import DEMO_CFG, changed, write


def described(folder: Path, text: str = DEMO_CFG) -> MachineDescription:
    return load_machine(write(folder, text))


def test_what_is_saved_counts_on_the_nodes_that_run(tmp_path: Path) -> None:
    stage = VirtualMachine(described(tmp_path), VirtualMachineOptions(), tmp_path)
    saved = "\n#*# <---------------------- SAVE_CONFIG ---------------------->\n#*#\n#*# [printer]\n"
    again = stage.of(described(tmp_path, f"{DEMO_CFG}{saved}#*# max_velocity = 123\n"))
    assert again.nodes == stage.description.nodes
    assert stage.description.limits.max_velocity != 123
    assert again.limits.max_velocity == 123


def test_other_nodes_need_another_start(tmp_path: Path) -> None:
    stage = VirtualMachine(described(tmp_path), VirtualMachineOptions(), tmp_path)
    moved = changed("5e1ec7ab1e02", "5e1ec7ab1e03", DEMO_CFG)
    with pytest.raises(CanductorError, match=r"node 'toolhead' is not connected as when .* start it again"):
        stage.of(described(tmp_path, moved))

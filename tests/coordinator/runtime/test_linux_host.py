"""Buses and lines of this computer that are not there: one sentence that says what to do."""

from pathlib import Path

import pytest

from coordinator.cli.commands.run import RunOptions, run_machine
from nodes.support.errors import CanductorError
from tests.stages.printer_text import changed, without_endstops, write

MCU_ON_CAN = """\
canbus_uuid: 90a4ae022dfc       # what a query of the bus prints, 12 hex digits
canbus_interface: can0
"""


@pytest.mark.parametrize(
    ("where", "about"),
    [
        (
            "canbus_uuid: 90a4ae022dfc\ncanbus_interface: virtual:/nowhere/bus",
            "no virtual CAN bus answers there",
        ),
        ("canbus_uuid: 90a4ae022dfc\ncanbus_interface: can77", "can77"),
        ("canbus_uuid: 90a4ae022dfc\ncanbus_interface: virtual:", r"machine\.cfg:"),
        ("canbus_uuid: 90a4ae022dfc\ncanbus_interface: nosuchbackend:0", "nosuchbackend"),
        ("serial: /dev/ttyNONE7", "/dev/ttyNONE7.* no such device"),
    ],
)
def test_one_sentence_for(tmp_path: Path, where: str, about: str) -> None:
    text = changed(MCU_ON_CAN, where + "\n", without_endstops())
    config = Path(write(tmp_path, text, "machine.cfg"))
    gcode = Path(write(tmp_path, "G28\n", "job.gcode"))
    with pytest.raises(CanductorError, match=about) as error:
        run_machine(RunOptions(config=config, gcode=gcode, json=True))
    assert "\n" not in str(error.value)

"""``canductor demo --socketcan``: its nodes on two of the kernel's CAN interfaces and a pseudo-terminal."""

from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.model import CanConnection, UartConnection
from coordinator.demo.run import DemoOptions
from coordinator.support.examples import DEMO_MACHINE
from coordinator.virtual_machine.virtual_machine import VirtualMachine
from tests.canbus_tools.command import Command
from tests.vcan.kernel import INTERFACE, SECOND_INTERFACE, why_no_socketcan

REASON = why_no_socketcan() or why_no_socketcan(SECOND_INTERFACE)
pytestmark = pytest.mark.skipif(bool(REASON), reason=REASON)

TOOLHEAD = "[mcu toolhead]\ncanbus_uuid: 5e1ec7ab1e02\ncanbus_interface: can"


def test_nodes_on_two_interfaces_and_a_uart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = DEMO_MACHINE.read_text()
    assert f"{TOOLHEAD}0" in text
    machine = tmp_path / "machine.cfg"
    machine.write_text(text.replace(f"{TOOLHEAD}0", f"{TOOLHEAD}1"))
    options = DemoOptions(machine=machine, socketcan={"can0": INTERFACE, "can1": SECOND_INTERFACE})
    with VirtualMachine(load_machine(str(machine)), options, tmp_path) as stage:
        mcu, toolhead, zboard = (node.connection for node in stage.description.nodes)
        for connection, interface in ((mcu, INTERFACE), (toolhead, SECOND_INTERFACE)):
            assert isinstance(connection, CanConnection)
            assert connection.interface == interface
            waiting = Command(None, capsys, ("-c", interface))("query", "--json").json["nodes"]
            assert [node["uuid"] for node in waiting] == [connection.uuid]
        assert isinstance(zboard, UartConnection)
        said = Command(None, capsys).run("console", "--uart", zboard.path, "-e", "get_uptime")
        assert "uptime high=" in said.out, said
